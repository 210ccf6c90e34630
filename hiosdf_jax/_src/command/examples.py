"""What the help of `hiosdf` and of each of its subcommands ends with: examples and outcomes."""

HIOSDF = """\
examples:
  hiosdf demo                           map a simulated apartment, score the map and draw it
  hiosdf demo --plan                    let a robot explore the apartment
  hiosdf map house_depth.npz            map a recorded stream, score the map and draw it
  hiosdf map house_depth.npz --view     the same, in a browser while the map grows
  hiosdf eval map.npz house_depth.npz   score a saved map against exact distances
  hiosdf map --help                     streams, ground truth, and what else a run can do
  hiosdf view map.npz                   show a saved map in a browser
  hiosdf export map.npz --to map.vti    write it for ParaView, ROS, Blender, numpy
  hiosdf info map.npz                   describe a saved map
  hiosdf bench                          measure the speed on this machine
"""

DEMO = """\
examples:
  hiosdf demo --frames 20               the same path with fewer frames
  hiosdf demo --config paper --seed 1   with the numbers of the paper
  hiosdf demo --plan --seed 3           a robot drives from one room to another

The folder gets metrics.json, slices.png, mesh.ply, mesh.png and growing.gif, which shows the map
grow; with --plan it gets metrics.json, plan.png and plan.gif. Ctrl-C ends the mapping as it does
with hiosdf map; with --plan it ends the run at once, and nothing is written.
"""

MAP = """\
examples:
  hiosdf map house_depth.npz --frames 20 --save map.npz
      map the first 20 frames, and keep the map for hio.load("map.npz")
  hiosdf map rgbd_dataset_freiburg1_desk
      a TUM RGB-D sequence; the format is recognized from the folder
  hiosdf map drive/ --cloud-topic /points --odometry-topic /odom
      a ROS bag with several clouds and no tf
  hiosdf map scans/ --trajectory poses.txt --bounds -5 -5 0 5 5 3 --max-range 8
      a folder of .ply or .pcd clouds; given both, bounds and range need no first reading
  hiosdf map stream.npz --ground-truth house.ply
      score the map against a mesh of the scene
  hiosdf map drive/ --save map.npz --checkpoint-every 100
  hiosdf map drive/ --save map.npz --resume map.npz
      write the map after every 100 updates, and continue it after a stop or a crash
  hiosdf map drive/ --refine-poses --drift 0.01 0.2
      poses that drift by 1 % of the distance traveled and 0.2 degrees per meter: also writes
      trajectory.txt, trajectory.npz and trajectory.png
  hiosdf map scans/ --odometry
      clouds without poses: the world of the map is the sensor at the first frame

The folder gets metrics.json, slices.png, mesh.ply and mesh.png. The map is scored against the
exact distances of the .npz file (eval_*) or of --ground-truth. Without either it is scored on
every tenth frame, which it is not given.

A bad frame ends the mapping with exit code 2. SIGINT (Ctrl-C), SIGTERM and SIGHUP end it after the
current frame with exit code 130, 143 and 129; a second one ends it at once. In each case the map so
far is scored, drawn and written, to --save or to checkpoint.npz in the folder. --resume continues
it, but not with --refine-poses or --odometry: the file of a map has no poses.
"""

VIEW = """\
examples:
  hiosdf view map.npz                        until Ctrl-C, at http://127.0.0.1:8080
  hiosdf view map.npz --export scene.html    one file that needs no server, and no view
  hiosdf view map.npz --host 0.0.0.0         other machines can connect, without a password

MAP is a file of hiosdf map --save or of hio.save. The view needs the extra [view]: in a clone,
pip install '.[view]'.
"""

EXPORT = """\
examples:
  hiosdf export map.npz --to map.vti --resolution 0.1
      the field for ParaView; .npz has the same for numpy
  hiosdf export map.npz --to floor.yaml --floor 0 --height 1.2 --radius 0.3
      a costmap for ROS navigation: floor.yaml and floor.pgm
  hiosdf export map.npz --to map.glb
      the mesh for Blender and browsers; .ply has it in the world frame
  hiosdf export map.npz --to map.safetensors
      the weights of the network
  hiosdf export map.npz --to scene.html
      the view in one file
  hiosdf export hiosdf_output/demo/metrics.json --to metrics.csv
      the metrics of a run, for a spreadsheet
"""

EVAL = """\
examples:
  hiosdf eval map.npz house_depth.npz                        the exact distances of the stream
  hiosdf eval map.npz scans/ --ground-truth house.ply        a mesh of the scene
  hiosdf eval map.npz house_depth.npz --to metrics.json      and as JSON
"""

BENCH = """\
examples:
  hiosdf bench                        with the configuration that suits the device
  hiosdf bench --json bench.json      and as JSON
  JAX_COMPILATION_CACHE_DIR=~/.cache/jax hiosdf bench
      twice: the second run reads the compiled functions from the folder
"""
