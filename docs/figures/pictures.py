"""Pictures of the page "Environments and anomalies": a frame, and an episode beside its twin.

Plots are SVG files of some kilobytes, with a white ground of their own. The same versions draw the
same bytes on the same processor.
"""

import struct
import zlib
from collections.abc import Iterator, Mapping
from html import escape
from typing import Final

import numpy as np
from numpy.typing import NDArray
from oodd_recording.calibrate import setup_of
from oodd_recording.environments import Bullet, Simulator, make, quiet_streams
from oodd_recording.record import SHORTEST_TWIN, RecordedEpisode, record_anomalous
from oodd_recording.values import VALUES, spread_of

from oodd_eval.data.facts import ENVIRONMENTS

FIRST_SEED: Final = 960_000_000  # apart from those of splits, policies and calibration
BEFORE, AFTER = 30, 90  # rows of a plot before the onset and after the effect
WIDTH, HEIGHT = 480, 190
LEFT, RIGHT, TOP, BOTTOM = 60, 472, 44, 152  # of the plot's axes
TWIN, CORRUPTED, INK, LINE = "#555555", "#d55e00", "#222222", "#bbbbbb"

Image = NDArray[np.uint8]


def draw_pictures(
    environment: str, rungs: Mapping[str, tuple[str, float]]
) -> Iterator[tuple[str, bytes]]:
    """Draw the frame of an environment, and a plot for each kind at a rung and its strength.

    Gives names, relative to the folder of the pages, and contents.
    """
    setup = setup_of(environment)
    twins = (setup.record(FIRST_SEED + i) for i in range(100))
    twin = next(t for t in twins if t.trajectory.transitions >= SHORTEST_TWIN)
    yield f"{environment}.png", png(frame(environment, twin))
    for kind, (rung, strength) in rungs.items():
        episode = record_anomalous(setup, kind, strength, twin)
        title = f"{kind} at {rung} ({strength:g})"
        yield f"{environment}/{kind}.svg", plot(environment, title, episode, twin).encode()


def frame(environment: str, episode: RecordedEpisode) -> Image:
    """Return the picture half-way through a nominal episode, of shape (height, width, 3)."""
    actions = episode.trajectory.actions[: episode.trajectory.transitions // 2]
    simulator = make(environment)
    try:
        simulator.reset(episode.seed)
        for row in actions:
            simulator.step(int(row.argmax()) if ENVIRONMENTS[environment].discrete else row)
        with quiet_streams():
            return _look(simulator)
    finally:
        simulator.close()


def _look(simulator: Simulator) -> Image:
    env = simulator.env
    if isinstance(simulator, Bullet):
        client = env._p  # noqa: SLF001  # the simulator's only handle
        view = client.computeViewMatrixFromYawPitchRoll(env.robot.body_xyz, 2.8, 30, -25, 0, 2)
        lens = client.computeProjectionMatrixFOV(45, 4 / 3, 0.1, 50)
        width, height, pixels, _, _ = client.getCameraImage(
            320, 240, view, lens, renderer=client.ER_TINY_RENDERER
        )
        return np.array(pixels, np.uint8).reshape(height, width, 4)[..., :3]
    env.render_mode = "rgb_array"
    large: NDArray[np.float64] = env.render().astype(np.float64)
    blocks = large.reshape(large.shape[0] // 2, 2, large.shape[1] // 2, 2, 3)
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
    among: list[int] = episode.parameters.get("sensors", VALUES["sensors"][environment])
    return max(among, key=lambda i: float(gap[i] / spread_of(environment)[i]))


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
    low, high = float(values.min()), float(values.max())

    def x(step: float) -> float:
        return LEFT + (RIGHT - LEFT) * (step - first) / (last - first)

    def y(value: float) -> float:
        return BOTTOM - (BOTTOM - TOP) * (value - low) / ((high - low) or 1)

    quantity = ENVIRONMENTS[environment].sensors[sensor]
    unit = "" if quantity.unit == "1" else f" ({quantity.unit})"
    shapes = [
        _text(LEFT, 16, title, "start", "bold"),
        _text(LEFT, 34, quantity.name + unit, "start"),
        _text(x(onset), HEIGHT - 6, f"onset, step {onset}"),
        f'<path d="M{x(onset):.1f} {TOP}V{BOTTOM + 6}" stroke="{INK}" stroke-dasharray="4 3"/>',
    ]
    for value in (low, high):
        label = f"{float(f'{value:.2g}') + 0:g}"  # neither 1.2e+02 nor -0
        shapes.append(_text(LEFT - 6, y(value) + 4, label, "end"))
        shapes.append(f'<path d="M{LEFT} {y(value):.1f}H{RIGHT}" stroke="{LINE}"/>')
    ends = (first, "start"), (last, "end")
    shapes += [_text(x(step), BOTTOM + 16, f"{step}", anchor) for step, anchor in ends]
    for colour, line in lines.items():
        points = " ".join(f"{x(first + i):.1f},{y(value):.1f}" for i, value in enumerate(line))
        shapes.append(f'<polyline points="{points}" stroke="{colour}" stroke-width="1.5"/>')
    if (end := len(episode.trajectory) - 1) < last:
        shapes.append(
            f'<circle cx="{x(end):.1f}" cy="{y(lines[CORRUPTED][-1]):.1f}" r="3.5" '
            f'fill="{CORRUPTED}"/>'
        )
    size = f'width="{WIDTH}" height="{HEIGHT}"'
    font = 'font-family="sans-serif" font-size="12"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" {size} {font}'
    ground = f'<rect {size} fill="white"/>'
    return "\n".join([f'{head} fill="none">', ground, *shapes, "</svg>\n"])


def _text(x: float, y: float, text: str, anchor: str = "middle", weight: str = "normal") -> str:
    anchoring = f'x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-weight="{weight}"'
    return f'<text {anchoring} fill="{INK}">{escape(text)}</text>'
