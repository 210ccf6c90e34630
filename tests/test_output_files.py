"""Files that are written whole or not at all."""

import errno
import os
import resource
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hiosdf_jax._src.output_files import (
    check_output,
    check_output_folder,
    replacing,
    replacing_together,
)

OLD, NEW = b"old" * 1000, b"new" * 2000
NAMES = ("mesh.ply", "mesh.png", "metrics.json")


def write(path, content=NEW):
    with replacing(path) as file:
        file.write(content)


def listing(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def unprivileged(tmp_path):
    """Does a test as a user whom rights bind; root may write everywhere."""
    tmp_path.chmod(0o777)
    if os.geteuid() != 0:
        yield
        return
    for folder in tmp_path.parents[:3]:  # with a folder per worker
        folder.chmod(0o711)
    os.seteuid(65534)
    yield
    os.seteuid(0)


def test_a_new_file_has_the_rights_of_any_other(tmp_path):
    write(tmp_path / "new")
    (tmp_path / "other").write_bytes(b"")
    assert (tmp_path / "new").read_bytes() == NEW
    assert (tmp_path / "new").stat().st_mode == (tmp_path / "other").stat().st_mode
    assert listing(tmp_path) == ["new", "other"]


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o664, 0o777])
def test_the_rights_of_an_old_file_are_kept_from_the_first_byte(tmp_path, mode):
    path = tmp_path / "file"
    path.write_bytes(OLD)
    path.chmod(mode)
    with replacing(path) as file:
        assert stat.S_IMODE(os.fstat(file.fileno()).st_mode) == mode
        file.write(NEW)
        assert path.read_bytes() == OLD
    assert path.read_bytes() == NEW
    assert stat.S_IMODE(path.stat().st_mode) == mode


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
def test_the_owner_of_an_old_file_is_kept(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(OLD)
    os.chown(path, 1234, 5678)
    write(path)
    assert (path.stat().st_uid, path.stat().st_gid) == (1234, 5678)


def test_a_link_stays_and_its_target_is_replaced(tmp_path):
    (tmp_path / "real").mkdir()
    target, link, chain = tmp_path / "real" / "map", tmp_path / "link", tmp_path / "chain"
    target.write_bytes(OLD)
    link.symlink_to("real/map")
    chain.symlink_to("link")
    write(chain)
    assert link.is_symlink() and chain.is_symlink()
    assert target.read_bytes() == NEW
    assert not target.is_symlink()
    target.unlink()
    write(link)  # it leads nowhere, into a folder that is there
    assert link.is_symlink() and target.read_bytes() == NEW
    assert listing(tmp_path / "real") == ["map"]


def refusals(tmp_path):
    """Files that cannot be written, by the error of each."""
    read_only, loop = tmp_path / "read_only", tmp_path / "loop"
    read_only.write_bytes(OLD)
    read_only.chmod(0o444)
    loop.symlink_to(loop)
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "lost").symlink_to("none/map")
    return [
        (read_only, PermissionError, "the file is read-only"),
        (tmp_path, IsADirectoryError, "Is a directory"),
        (tmp_path / "none" / "map", FileNotFoundError, "no such folder"),
        (tmp_path / "lost", FileNotFoundError, "no such folder"),
        (read_only / "map", NotADirectoryError, "Not a directory"),
        (loop, OSError, "not a regular file"),
        (tmp_path / "pipe", OSError, "not a regular file"),
        (Path("/dev/null"), OSError, "not a regular file"),
        (tmp_path / ("long" * 64), OSError, "File name too long"),
    ]


def test_what_cannot_be_written_is_refused_and_stays(tmp_path):
    expected = refusals(tmp_path)
    before = listing(tmp_path)
    for path, kind, message in expected:
        for call in (check_output, write):
            with pytest.raises(kind, match=message) as caught:
                call(path)
            assert caught.value.filename
            assert ".part" not in str(caught.value)
    assert listing(tmp_path) == before
    assert (tmp_path / "read_only").read_bytes() == OLD
    assert stat.S_ISCHR(Path("/dev/null").stat().st_mode)


def test_a_folder_without_rights_is_refused(tmp_path, unprivileged):
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "map").write_bytes(OLD)
    folder.chmod(0o555)
    for call in (check_output, write):
        with pytest.raises(PermissionError, match=f"Permission denied: '{folder}"):
            call(folder / "map")
    for output in (folder, folder / "deep" / "out"):
        with pytest.raises(PermissionError, match=f"Permission denied: '{folder}"):
            check_output_folder(output, NAMES)
    assert listing(folder) == ["map"] and (folder / "map").read_bytes() == OLD
    folder.chmod(0o755)


def test_a_file_of_someone_else_is_refused(tmp_path, unprivileged):
    if os.getuid() != 0:
        pytest.skip("needs root, to make a file of someone else")
    path = tmp_path / "map"
    os.seteuid(0)
    path.write_bytes(OLD)
    os.seteuid(65534)
    with pytest.raises(PermissionError, match="the file is read-only"):
        check_output(path)


def test_a_check_changes_nothing(tmp_path):
    (tmp_path / "map").write_bytes(OLD)
    check_output(tmp_path / "map")
    check_output(tmp_path / "new")
    check_output_folder(tmp_path, NAMES)
    check_output_folder(tmp_path / "deep" / "out", NAMES)
    assert listing(tmp_path) == ["map"]


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "disk full"), KeyboardInterrupt()])
def test_an_error_keeps_the_old_file(tmp_path, error):
    path = tmp_path / "map"
    path.write_bytes(OLD)
    with pytest.raises(type(error)), replacing(path) as file:
        file.write(NEW)
        raise error
    assert path.read_bytes() == OLD
    assert listing(tmp_path) == ["map"]


@pytest.fixture
def small_disk():
    """A limit of a file's size, which fails as a full disk does: in `write`, part way."""
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    old = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limit[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    signal.signal(signal.SIGXFSZ, old)


def test_a_full_disk_keeps_the_old_file_and_names_it(tmp_path, small_disk):
    path = tmp_path / "map"
    path.write_bytes(OLD)
    with pytest.raises(OSError) as caught:
        write(path, bytes(100_000))
    assert (caught.value.errno, caught.value.filename) == (errno.EFBIG, str(path))
    assert path.read_bytes() == OLD
    assert listing(tmp_path) == ["map"]


def test_abandoned_files_are_removed_and_those_of_living_writers_kept(tmp_path):
    path, digits = tmp_path / "map.npz", "0123456789abcdef" * 2
    abandoned = tmp_path / f"map.npz.{digits}.part"
    abandoned.write_bytes(OLD)
    others = [
        f"map_npz.{digits}.part",
        f"map.npz.{digits}.part.txt",
        f"map.npz.{digits[:-1]}.part",
        f"other.npz.{digits}.part",
        "map.npz.part",
    ]
    for name in others:
        (tmp_path / name).write_bytes(OLD)
    with replacing(path) as first:
        first.write(OLD)
        write(path)  # must not take the first writer's file
        assert not abandoned.exists()
    assert path.read_bytes() == OLD
    assert listing(tmp_path) == sorted([*others, "map.npz"])


KILLED = """
import sys
from hiosdf_jax._src.output_files import replacing, replacing_together
if sys.argv[1] != "together":
    with replacing(sys.argv[2]) as file:
        file.write(bytes(1000))
        print("writing", flush=True)
        sys.stdin.read()
with replacing_together(sys.argv[2], ["a"]) as folder:
    (folder / "a").write_bytes(b"half")
    print("writing", flush=True)
    sys.stdin.read()
"""


LONGEST = "maß" * 63 + "x" * 3  # 255 bytes: the most that a file system takes


@pytest.mark.parametrize("name", [LONGEST, "x" * 101, "x" * 220])
def test_a_name_may_be_as_long_as_the_file_system_allows(tmp_path, name):
    path = tmp_path / name
    check_output(path)
    with replacing(path) as file:
        file.write(NEW)
        (part,) = listing(tmp_path)
        assert len(os.fsencode(part)) < 140
        write(tmp_path / f"{name[:-1]}y", OLD)  # another file's: this one stays
        assert part in listing(tmp_path)
    assert path.read_bytes() == NEW and len(listing(tmp_path)) == 2


def test_a_name_that_is_too_long_is_refused(tmp_path):
    path = tmp_path / f"{LONGEST}x"
    for check in (check_output, write, lambda path: check_output_folder(path, NAMES)):
        with pytest.raises(OSError) as caught:
            check(path)
        assert (caught.value.errno, caught.value.filename) == (errno.ENAMETOOLONG, str(path))
    assert listing(tmp_path) == []


@pytest.mark.parametrize("kind", ["one", "long", "together"])
def test_a_killed_writer_leaves_what_the_next_one_removes(tmp_path, kind):
    path = tmp_path / {"one": "file", "long": LONGEST, "together": ""}[kind]
    arguments = [sys.executable, "-c", KILLED, kind, str(path)]
    with subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as writer:
        assert writer.stdout.readline() == b"writing\n"
        (part,) = listing(tmp_path)
        assert part.endswith(".part")
        replace = write_together if kind == "together" else write
        replace(path)  # while it lives
        assert part in listing(tmp_path)
        writer.kill()
    replace(path)
    assert not [name for name in listing(tmp_path) if name.endswith(".part")]


def write_together(folder, contents=None):
    with replacing_together(folder, NAMES) as aside:
        for name, content in (contents or {"metrics.json": NEW}).items():
            write(aside / name, content)


def test_files_replace_others_together_or_not_at_all(tmp_path):
    output = tmp_path / "deep" / "out"
    write_together(output, {"mesh.ply": OLD, "metrics.json": OLD})
    (output / "notes.txt").write_bytes(b"the user's own")
    (output / "metrics.json").chmod(0o600)
    before = {path.name: path.read_bytes() for path in output.iterdir()}
    with pytest.raises(RuntimeError), replacing_together(output, NAMES) as aside:
        write(aside / "mesh.ply")
        raise RuntimeError
    assert {path.name: path.read_bytes() for path in output.iterdir()} == before
    write_together(output, {"mesh.png": NEW, "metrics.json": NEW})
    assert listing(output) == ["mesh.png", "metrics.json", "notes.txt"]  # no mesh.ply of old
    assert stat.S_IMODE((output / "metrics.json").stat().st_mode) == 0o600
    assert (output / "metrics.json").read_bytes() == NEW


def test_together_keeps_links(tmp_path):
    (tmp_path / "elsewhere").write_bytes(OLD)
    output = tmp_path / "out"
    output.mkdir()
    (output / "metrics.json").symlink_to("../elsewhere")
    write_together(output)
    assert (output / "metrics.json").is_symlink()
    assert (tmp_path / "elsewhere").read_bytes() == NEW


def test_one_file_that_cannot_be_replaced_keeps_all(tmp_path):
    write_together(tmp_path, {"mesh.ply": OLD, "metrics.json": OLD})
    (tmp_path / "metrics.json").chmod(0o444)
    with pytest.raises(PermissionError, match=r"read-only.*metrics\.json"):
        check_output_folder(tmp_path, NAMES)
    with pytest.raises(PermissionError, match="read-only"):
        write_together(tmp_path, {"mesh.ply": NEW, "metrics.json": NEW})
    assert (tmp_path / "mesh.ply").read_bytes() == OLD
    assert listing(tmp_path) == ["mesh.ply", "metrics.json"]


def test_an_output_folder_is_a_folder(tmp_path):
    (tmp_path / "file").write_bytes(OLD)
    for output in (tmp_path / "file", tmp_path / "file" / "out"):
        with pytest.raises(FileExistsError, match="File exists"):
            check_output_folder(output, NAMES)


def test_many_writers_of_one_file(tmp_path):
    """Each reads a whole file, whoever wrote it, and nothing is left over."""
    path = tmp_path / "map"
    program = (
        "import sys\n"
        "from hiosdf_jax._src.output_files import replacing\n"
        "for _ in range(100):\n"
        "    with replacing(sys.argv[1]) as file:\n"
        "        file.write(sys.argv[2].encode() * 50_000)\n"
    )
    writers = [
        subprocess.Popen([sys.executable, "-c", program, str(path), letter]) for letter in "abc"
    ]
    until = time.monotonic() + 60
    while any(writer.poll() is None for writer in writers) and time.monotonic() < until:
        if path.exists():
            content = path.read_bytes()
            assert len(content) == 50_000 and len(set(content)) == 1
        time.sleep(0.01)
    assert [writer.wait() for writer in writers] == [0, 0, 0]
    assert listing(tmp_path) == ["map"]
