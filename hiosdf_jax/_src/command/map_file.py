"""The file of a run's map, written while the map grows, so that a run can be resumed."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from hiosdf_jax._src.command.progress import Progress, SavedMap, save_map
from hiosdf_jax._src.mapping import checkpoint
from hiosdf_jax._src.state.pytrees import MapState

UNFINISHED = "checkpoint.npz"  # the map of a run that has not finished


def path_of_map(output: Path, save_path: str | os.PathLike[str] | None) -> Path:
    """Returns the file to which a run writes its map until it has finished.

    Args:
        output: The folder of the results.
        save_path: Where the map of a finished run is written, if anywhere.

    Returns:
        The file.
    """
    return output / UNFINISHED if save_path is None else Path(save_path)


class MapFile:
    """The file of a run's map.

    Attributes:
        error: Why the map could not be kept the last time, if it could not.
    """

    def __init__(
        self,
        output: Path,
        save_path: str | os.PathLike[str] | None,
        *,
        resume_path: str | os.PathLike[str] | None,
        frames: int,
        seed: int,
        held_out: bool,
        with_progress: bool,
    ) -> None:
        """Writes nothing yet.

        Args:
            output: The folder of the results.
            save_path: See `path_of_map`.
            resume_path: The file of the map that the run continues. The run may replace it.
            frames: Number of frames of the stream.
            seed: Seed of the run.
            held_out: Whether the run scores the map on frames that the map is not given.
            with_progress: Whether the file says how far the map has come, so that it can be
                resumed.
        """
        self.error: OSError | None = None
        self._path = path_of_map(output, save_path)
        self._unfinished = output / UNFINISHED  # the same file, if there is no `save_path`
        self._is_result = save_path is not None
        self._own = set() if resume_path is None else {Path(resume_path).resolve()}
        self._frames, self._seed, self._held_out = frames, seed, held_out
        self._with_progress = with_progress

    def write(self, state: MapState, progress: Progress) -> Path:
        """Writes the map. A file of another run is renamed before an unfinished map replaces it.

        Args:
            state: The map.
            progress: How far it has come.

        Returns:
            The file.

        Raises:
            OSError: The file cannot be written.
        """
        self._path.parent.mkdir(parents=True, exist_ok=True)
        place = self._path.resolve()
        if place not in self._own and progress.next_frame < self._frames:
            _set_aside(place)
        if self._with_progress:
            save_map(self._path, SavedMap(state, progress, self._seed, self._held_out))
        else:
            checkpoint.save(self._path, state)
        self._own.add(place)
        return self._path

    def keep(self, state: MapState, progress: Progress) -> None:
        """Writes the map if it can; see `write`. Otherwise it prints why, and `error` has it."""
        try:
            self.write(state, progress)
            self.error = None
        except OSError as error:  # no reason to lose the map in memory, or the scores and pictures
            self.error = error
            print(f"the map could not be written: {error}", file=sys.stderr)

    def remove_unfinished(self) -> None:
        """Removes the unfinished map at the end of the run, unless it is another run's."""
        unfinished = self._unfinished.resolve()
        if self._is_result and self._path.resolve() == unfinished:
            return
        if unfinished in self._own:
            self._unfinished.unlink(missing_ok=True)
        elif self._unfinished.exists():
            print(f"{self._unfinished} is of an earlier run that was stopped")


def _set_aside(path: Path) -> None:
    """Renames a map of another run, which a map that is not finished would replace."""
    if not path.is_file():
        return
    number = 1
    while (aside := path.with_stem(f"{path.stem}.{number}")).exists():
        number += 1
    path.rename(aside)
    print(f"{path} is of another run: kept as {aside.name}")
