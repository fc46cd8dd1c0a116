"""Pictures of an environment's page: a frame, and an episode beside its twin.

Plots are SVG files of some kilobytes, with a white ground of their own. The same versions draw the
same bytes on the same processor.
"""

import struct
import warnings
import zlib
from typing import Final

import numpy as np

from oodd_eval.errors import SimulationError
from oodd_recording.closed_loop import SHORTEST_TWIN, RecordedEpisode, Setup
from oodd_recording.environments import make
from oodd_recording.registered import MEASURED, info_of
from oodd_recording.simulator import Image, quiet_streams
from oodd_recording.svg import INK, LEFT, WIDTH, Axes, label, svg
from oodd_recording.values import spread_of

FIRST_SEED: Final = 960_000_000  # apart from those of splits, policies and calibration
TWINS: Final = 100  # seeds among which a twin is looked for
WIDEST: Final = 400  # pixels of a frame
BEFORE, AFTER = 30, 90  # rows of a plot before the onset and after the effect
HEIGHT: Final = 190  # pixels of a plot
TWIN, CORRUPTED = "#555555", "#d55e00"


def pictured_twin(setup: Setup) -> RecordedEpisode:
    """Return the nominal episode of all pictures: the first that is long enough for an onset."""
    twins = (setup.record(FIRST_SEED + i) for i in range(TWINS))
    for twin in twins:
        if twin.trajectory.transitions >= SHORTEST_TWIN:
            return twin
    raise SimulationError(
        f"none of {TWINS} nominal episodes of {setup.environment} has {SHORTEST_TWIN} transitions, "
        "expected one, for an onset: a better policy is needed"
    )


def frame(environment: str, episode: RecordedEpisode) -> bytes | None:
    """Return a picture half-way through a nominal episode, as PNG; None where none can be drawn."""
    actions = episode.trajectory.actions[: episode.trajectory.transitions // 2]
    simulator = make(environment)
    try:
        simulator.reset(episode.seed)
        for row in actions:
            simulator.step(int(row.argmax()) if info_of(environment).discrete else row)
        with quiet_streams(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            image = np.asarray(simulator.image())
    except Exception:  # noqa: BLE001  many draw nothing, or not without a screen: a page goes without
        return None
    finally:
        simulator.close()
    if image.ndim != 3 or image.shape[-1] != 3 or image.dtype != np.uint8:
        return None
    while image.shape[1] > WIDEST:
        image = _halved(image)
    return png(image)


def _halved(image: Image) -> Image:
    """Return an image of half the height and width; an odd last line is left out."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    blocks = image[: 2 * height, : 2 * width].astype(np.float64).reshape(height, 2, width, 2, 3)
    halved: Image = blocks.mean(axis=(1, 3)).round().astype(np.uint8)
    return halved


def png(image: Image) -> bytes:
    """Return an image of shape (height, width, 3) as a PNG file."""

    def chunk(name: bytes, content: bytes) -> bytes:
        checked = name + content
        return struct.pack(">I", len(content)) + checked + struct.pack(">I", zlib.crc32(checked))

    height, width, _ = image.shape
    lines = np.hstack([np.zeros((height, 1), np.uint8), image.reshape(height, -1)])  # unfiltered
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    content = zlib.compress(lines.tobytes(), 9)
    chunks = chunk(b"IHDR", head), chunk(b"IDAT", content), chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def telling_sensor(environment: str, episode: RecordedEpisode, twin: RecordedEpisode) -> int:
    """Return the sensor that differs most from the twin's in the rows that are plotted, in spreads.

    Among the corrupted ones, or for an anomaly of the dynamics among all that may break.
    """
    rows, others = episode.trajectory.observations, twin.trajectory.observations
    effect = episode.effect or 0
    plotted = slice(effect, min(len(rows), len(others), effect + AFTER))
    gap = np.abs(rows[plotted] - others[plotted]).mean(axis=0)
    spread = spread_of(environment)
    among = episode.parameters.get("sensors") or MEASURED[environment].sensors
    return max(among, key=lambda i: float(gap[i] / (spread[i] or 1.0)))


def plot(environment: str, title: str, episode: RecordedEpisode, twin: RecordedEpisode) -> str:
    """Return an SVG picture of one sensor of an episode and of its twin around the onset."""
    sensor = telling_sensor(environment, episode, twin)
    onset, effect = episode.onset or 0, episode.effect or 0  # which may come much later
    first, last = max(0, onset - BEFORE), effect + AFTER
    lines = {
        colour: e.trajectory.observations[first : last + 1, sensor].astype(np.float64)
        for colour, e in ((TWIN, twin), (CORRUPTED, episode))
    }
    values = np.concatenate([*lines.values()])
    axes = Axes(first, last, float(values.min()), float(values.max()))
    quantity = info_of(environment).sensors[sensor]
    unit = "" if quantity.unit == "1" else f" ({quantity.unit})"
    shapes = [
        label(LEFT, 16, title, "start", "bold"),
        label(LEFT, 34, quantity.name + unit, "start"),
        label(axes.x(onset), HEIGHT - 6, f"onset, step {onset}"),
        axes.mark(onset, f'stroke="{INK}" stroke-dasharray="4 3"'),
        *axes.ends(),
    ]
    for colour, line in lines.items():
        shapes.append(axes.line(enumerate(line, first), f'stroke="{colour}" stroke-width="1.5"'))
    if (end := len(episode.trajectory) - 1) < last:
        shapes.append(
            f'<circle cx="{axes.x(end):.1f}" cy="{axes.y(lines[CORRUPTED][-1]):.1f}" r="3.5" '
            f'fill="{CORRUPTED}"/>'
        )
    return svg(WIDTH, HEIGHT, shapes)
