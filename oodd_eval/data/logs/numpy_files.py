"""Episodes as ``.npz`` files with the arrays observations, actions, rewards and onset."""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from oodd_eval.data.bounded import EPISODE, read_npz
from oodd_eval.data.logs import ARRAYS, Log, Logs, Reader, episode_files, read_onsets, whole_number
from oodd_eval.errors import TrajectoryError


def _episodes(folder: Path) -> Iterator[Log]:
    onsets = read_onsets(folder)
    for path in episode_files(folder, ".npz"):
        arrays = read_npz(path, EPISODE, ARRAYS)
        if "observations" not in arrays:
            raise TrajectoryError(f"{path} lacks the array observations")
        onset = whole_number(str(path), "onset", arrays.get("onset", onsets.get(path.stem)))
        rows = arrays["observations"], arrays.get("actions"), arrays.get("rewards")
        yield Log(path.stem, str(path), *rows, onset)


READER: Final = Reader(
    "numpy",
    "a folder with a file *.npz for each episode",
    lambda folder: Logs(lambda: _episodes(folder)),
)
