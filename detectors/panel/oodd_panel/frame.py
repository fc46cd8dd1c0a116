"""A body's impulses in its own axes: what its engines, rotors or motors can do, and what not.

Between contacts the velocity of a body changes by what its actuators give and by a constant
acceleration such as gravity. In the world's axes an impulse turns with the body, in the body's own
axes it does not: there nominal impulses lie close together, and another one lies apart from them.
No equation is known: where axes, units and the constant acceleration make nominal impulses lie
closest together, there they are.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar, Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from oodd_common.charts import Floats

from oodd_eval import Trajectory
from oodd_eval.errors import FittedStateError
from oodd_eval.plugins.state import Arrays, State, take
from oodd_panel.voices import Voice

if TYPE_CHECKING:
    from oodd_panel.detector import PanelDetector

REST: Final = 40
"""Rows before and after a contact whose impulses are not those of the actuators alone."""
FLIGHT: Final = 500
"""Least rows without a contact, in at least `EPISODES` episodes, to learn impulses from."""
EPISODES: Final = 10
FOLDS: Final = 5
"""Parts of the episodes, each judged by the impulses of the others."""
POINTS: Final = 2000
"""Most nominal impulses that are kept."""
NEIGHBOURS: Final = 5
"""Nearest nominal impulses within whose distance another one is no event."""
LEAST_RADIUS: Final = 5e-3
"""Least such distance, in units of the spread."""
ROWS: Final = 64
"""Impulses whose neighbours are looked for at once."""
SAMPLES: Final = (200, 400, 800)
"""Impulses by which axes, units and the constant acceleration are found: first few, then more."""
RATIOS: Final = np.linspace(-1.2, 1.2, 9)
"""Logarithms of a velocity's unit that are tried first."""
CONSTANTS: Final = np.linspace(-3.0, 3.0, 13)
"""Constant changes of velocity that are tried first, in units of the spread."""
STEP: Final = 0.2
"""First step of the search from the best of these."""
SMALLER: Final = 0.6
"""Factor of each further step."""
STEPS: Final = 5
"""Steps with each number of impulses."""
CLOSEST: Final = 0.003
"""Distance, in units of the spread, below which points count as equally close: many are equal."""
GAIN: Final = 0.1
"""Least gain in nats with which turned impulses lie closer together, for the voice to speak."""
EXACT: Final = -0.5
"""Least correlation of successive changes of an angle's speed; of noisy readings it is -2/3."""
SHARE: Final = 0.99
"""Share of nominal distances up to which a distance is none to speak of."""
PHASE: Final = 4
"""Rows around a row whose largest nominal distance is expected at that row of an episode."""
MEASURES: Final = 2
"""Measures of a distance: by the spread of all impulses, and of those nearby."""
WEIGHTS: Final = (1.0, 0.1, 0.02)
"""Weights of the newest row in the sums."""
LIMIT: Final = 6.0
"""Limit of the logarithm of a distance."""
TINY: Final = 1e-12
_PLANES: Final = {1: [(0, 0, 1)], 2: [(1, 2, 0), (0, 1, 2)], 3: [(2, 0, 1), (1, 2, 0), (0, 1, 2)]}
"""By the number of angles: which of them turns which plane, one after the other."""


class Columns(NamedTuple):
    """Columns by role: two or three velocities, the angles that turn them, contacts, commands.

    `angles` are one, two (roll and pitch) or three (roll, pitch, yaw) angles in radians, or the
    cosine and the sine of one (`halves`). Commands may stand behind the sensors, before each row
    the last one; they are part of an impulse.
    """

    velocities: tuple[int, ...]
    angles: tuple[int, ...]
    contacts: tuple[int, ...]
    halves: bool
    commands: tuple[int, ...] = ()

    @classmethod
    def of(cls, roles: Sequence[str], commands: int = 0) -> Self | None:
        """Return the columns of a body's frame; None where roles say of none."""
        by_role = {
            role: tuple(i for i, name in enumerate(roles) if name == role) for role in {*roles}
        }
        velocities, angles = by_role.get("velocity", ()), by_role.get("angle", ())
        halves = by_role.get("cosine", ()) + by_role.get("sine", ())
        turns = {2: (1,), 3: (1, 2, 3)}.get(len(velocities), ())
        has_halves = not angles and len(halves) == 2 and "cosine" in by_role and "sine" in by_role
        if not turns or not (has_halves or len(angles) in turns):
            return None
        angles = halves if has_halves else angles
        behind = tuple(range(len(roles), len(roles) + commands))
        return cls(velocities, angles, by_role.get("contact", ()), has_halves, behind)

    def turns(self, rows: Floats) -> Floats:
        """Return the angles of rows in radians, (N, D) to (N, K)."""
        angles = rows[:, self.angles]
        if self.halves:
            pairs = angles.tolist()
            return np.array([[math.atan2(sine, cosine)] for cosine, sine in pairs])
        return angles


def waves(angles: Floats) -> Floats:
    """Return cosines and sines of angles, (N, K) to (2, K, N): of one row the bits of many."""
    return np.array(
        [[[f(a) for a in row] for row in angles.T.tolist()] for f in (math.cos, math.sin)]
    )


def turned(vectors: Floats, waves: Floats) -> Floats:
    """Return vectors of the world in the axes of a body, (N, 2 or 3), by `waves` of its angles.

    A single angle turns the plane of the first two axes; two are roll and pitch, three roll, pitch
    and yaw, of which yaw was turned first.
    """
    parts, (cosines, sines) = [*vectors.T], waves
    for k, i, j in _PLANES[len(cosines)]:
        c, s, x, y = cosines[k], sines[k], parts[i], parts[j]
        parts[i], parts[j] = c * x + s * y, c * y - s * x
    return np.stack(parts, axis=1)


class Points(NamedTuple):
    """Nominal impulses in units of their spread, (K, P), and how far they are apart, (P,).

    A radius is the distance to the `NEIGHBOURS`-th nearest other one.
    """

    columns: Floats
    radii: Floats

    @classmethod
    def of(cls, impulses: Floats) -> Self:
        """Return at most `POINTS` of some impulses, (N, K), with their radii."""
        columns = np.ascontiguousarray(impulses[:: -(-len(impulses) // POINTS)].T)
        radii = np.empty(columns.shape[1])
        for start in range(0, len(radii), ROWS):
            part = columns[:, start : start + ROWS]
            squares = ((part[:, :, None] - columns[:, None]) ** 2).sum(axis=0)
            nearest = np.partition(squares, NEIGHBOURS, axis=1)[:, NEIGHBOURS]
            radii[start : start + ROWS] = np.sqrt(nearest)
        return cls(columns, np.maximum(radii, LEAST_RADIUS))


class OwnFrame:
    """Nominal impulses in a body's axes, and how far from them nominal ones are.

    Attributes
    ----------
    columns
        Columns by role.
    touch
        Readings of contacts above which there is one.
    turn
        Whether changes of the angle's speed are part of an impulse.
    factors, constant
        Of velocities, (V,), and the change of them in a row that no actuator makes, (V,).
    points, spread
        Nominal impulses in units of their spread, (P, K), and that spread, (K,).
    usual
        Distances that are expected at the rows of an episode, (T, 2), the last for all later ones.
    scale
        Mean plus deviation of the largest sums of nominal episodes, (6,).
    """

    def __init__(self, columns: Columns) -> None:
        self.columns, self.turn = columns, False

    @property
    def width(self) -> int:
        """Numbers of an impulse."""
        return len(self.columns.velocities) + self.turn + len(self.columns.commands)

    def impulses(self, rows: Floats, speed: Floats) -> tuple[Floats, Floats]:
        """Return impulses between rows, (N - 1, K), and the last speed of the angle, (1,).

        `speed` is that before the first row; where it is empty, the first change of it is 0.
        """
        angles = self.columns.turns(rows)
        changes = np.diff(rows[:, self.columns.velocities], axis=0) * self.factors - self.constant
        parts = [turned(changes, waves(angles[:-1]))]
        if self.turn:
            speeds = _speeds(angles)
            parts.append(np.diff(speeds, prepend=speed if speed.size else speeds[:1])[:, None])
            speed = speeds[-1:]
        return np.concatenate([*parts, rows[1:, self.columns.commands]], axis=1), speed

    def fit(self, episodes: Sequence[Floats]) -> list[Floats]:
        """Learn from rows of nominal episodes; return each one's statistic, (T + 1,), out of fold.

        None of them where the frame says nothing: too few rows without contacts, noisy velocities,
        or impulses that lie no closer together in the body's axes than in the world's.
        """
        contacts = self.columns.contacts
        every = np.concatenate(episodes)[:, contacts]
        low, high = every.min(axis=0), every.max(axis=0)
        self.touch = tuple(np.where(high > low, (low + high) / 2, high / 2).tolist())
        free = [self._free(rows) for rows in episodes]
        if sum(map(np.sum, free)) < FLIGHT or sum(part.any() for part in free) < EPISODES:
            return []
        if not self._learn_axes(episodes, free):
            return []
        impulses = [
            self.impulses(rows, np.empty(0))[0][part]
            for rows, part in zip(episodes, free, strict=True)
        ]
        spread = np.concatenate(impulses).std(axis=0)
        self.spread = np.where(spread < TINY, 1.0, spread)
        scaled = [x / self.spread for x in impulses]
        left_out = [
            Points.of(np.concatenate([x for j, x in enumerate(scaled) if j % FOLDS != i]))
            for i in range(FOLDS)
        ]
        self.points = Points.of(np.concatenate(scaled))
        distances = np.full((len(episodes), max(map(len, episodes)), MEASURES), np.nan)
        for i, rows in enumerate(episodes):
            run = EpisodeRun(self)
            for t, row in enumerate(rows):
                distances[i, t] = run.distances(row, left_out[i % FOLDS])
        inner = [d[1 : len(part) + 1][part] for d, part in zip(distances, free, strict=True)]
        least = np.maximum(np.nanquantile(np.concatenate(inner), SHARE, axis=0), TINY)
        self.usual = _usual(distances, least)
        statistics = []
        for i, rows in enumerate(episodes):
            usual, run = _usual(np.delete(distances, i, axis=0), least), EpisodeRun(self)
            statistics.append(np.stack([run.sums(d, usual) for d in distances[i, : len(rows)]]))
        largest = np.stack([sums.max(axis=0) for sums in statistics])
        self.scale = np.maximum(largest.mean(axis=0) + largest.std(axis=0), TINY)
        return [(sums / self.scale).max(axis=1) for sums in statistics]

    def _free(self, rows: Floats) -> NDArray[np.bool_]:
        """Tell of which impulses, (T,), no row is near a contact, before or after it."""
        touches = (rows[:, self.columns.contacts] > np.array(self.touch)).any(axis=1)
        free: NDArray[np.bool_] = np.convolve(touches, np.ones(2 * REST + 1), "full") < 0.5
        free = free[REST : REST + len(rows)]
        free[:2] = False
        return free[1:]

    def _learn_axes(self, episodes: Sequence[Floats], free: Sequence[NDArray[np.bool_]]) -> bool:
        """Find units and the constant acceleration; tell whether the body's axes are of use."""
        columns = self.columns
        changes = [np.diff(rows[:, columns.velocities], axis=0) for rows in episodes]
        angles = [columns.turns(rows) for rows in episodes]
        moving = np.concatenate([x[part] for x, part in zip(changes, free, strict=True)])
        spread = moving.std(axis=0)
        if spread.min() < TINY:
            return False
        speeds = np.zeros((len(moving), 0))
        if len(columns.angles) == 1 or columns.halves:
            second = [np.diff(x, prepend=x[:1]) for x in map(_speeds, angles)]
            if _successive(second, free) > EXACT:
                self.turn = True
                speeds = np.concatenate([x[part] for x, part in zip(second, free, strict=True)])
                speeds = speeds[:, None] * (spread.mean() / max(speeds.std(), TINY))
        before = waves(np.concatenate([a[:-1][p] for a, p in zip(angles, free, strict=True)]))
        number = len(spread)
        size = float(spread.mean())
        order = np.random.default_rng(0).permutation(len(moving))

        def spread_out(values: Floats, rows: NDArray[np.intp]) -> float:
            ratios = np.concatenate([[0.0], values[: number - 1]])
            changes = moving[rows] * np.exp(ratios) - values[number - 1 :] * size
            body = np.concatenate([turned(changes, before[:, :, rows]), speeds[rows]], axis=1)
            return _disorder(body) - float(ratios.sum())

        # From the best of a grid for the last axis, which mostly points upwards.
        starts = [np.zeros(2 * number - 1)]
        for ratio, constant in itertools.product(RATIOS.tolist(), CONSTANTS.tolist()):
            starts.append(np.zeros(2 * number - 1))
            starts[-1][number - 2], starts[-1][-1] = ratio, constant * math.exp(ratio)
        best = min(starts, key=lambda values: spread_out(values, order[: SAMPLES[0]]))
        step = STEP
        for size_of_sample in SAMPLES[1:]:
            rows = order[:size_of_sample]
            least = spread_out(best, rows)
            for _ in range(STEPS):
                for k, sign in itertools.product(range(len(best)), (1.0, -1.0)):
                    tried = best.copy()
                    tried[k] += sign * step
                    if (value := spread_out(tried, rows)) < least:
                        best, least = tried, value
                step *= SMALLER
        self.factors = np.exp(np.concatenate([[0.0], best[: number - 1]]))
        self.constant = best[number - 1 :] * size
        plain = np.concatenate([moving[rows] * self.factors, speeds[rows]], axis=1)
        world = _disorder(plain) - float(np.log(self.factors).sum())
        return world - least >= GAIN

    def arrays(self) -> Arrays:
        """Return what `restore` takes."""
        return {
            "touch": np.array(self.touch),
            "turn": np.array(float(self.turn)),
            "factors": self.factors,
            "constant": self.constant,
            "points": self.points.columns,
            "radii": self.points.radii,
            "spread": self.spread,
            "usual": self.usual,
            "scale": self.scale,
        }

    def restore(self, arrays: State) -> None:
        """Take over a fit; `FittedStateError` for arrays of another one."""
        velocities = len(self.columns.velocities)
        self.touch = tuple(take(arrays, "touch", (len(self.columns.contacts),)).tolist())
        self.turn = bool(take(arrays, "turn", ()))
        self.factors = take(arrays, "factors", (velocities,), "+")
        self.constant = take(arrays, "constant", (velocities,))
        columns = take(arrays, "points", (self.width, None))
        self.points = Points(columns, take(arrays, "radii", (columns.shape[1],), "+"))
        self.spread = take(arrays, "spread", (self.width,), "+")
        self.usual = take(arrays, "usual", (None, MEASURES), "+")
        self.scale = take(arrays, "scale", (len(WEIGHTS) * MEASURES,), "+")


class EpisodeRun:
    """The statistic of one episode, row by row.

    Parameters
    ----------
    frame
        The fitted frame.
    """

    def __init__(self, frame: OwnFrame) -> None:
        self._frame, self._t, self._free = frame, -1, 0
        self._before = np.empty((0, 0))
        self._speed = np.empty(0)
        self._sums = [0.0] * (len(WEIGHTS) * MEASURES)
        self._latest: tuple[Floats, Floats] | None = None

    def __call__(self, row: Floats) -> float:
        """Return the statistic after the next row."""
        frame = self._frame
        sums = self.sums(self.distances(row, frame.points), frame.usual)
        return float((sums / frame.scale).max())

    def distances(self, row: Floats, points: Points) -> Floats:
        """Return how far the impulse before the next row is from nominal ones, (2,).

        In units of the impulses' spread, and of how far nominal ones lie apart there; NaN where it
        may not be that of the actuators alone.
        """
        frame, columns = self._frame, self._frame.columns
        touches = any(row[i] > low for i, low in zip(columns.contacts, frame.touch, strict=True))
        self._free = -REST if touches else self._free + 1
        before, self._before = self._before, row[None]
        if not before.size:
            return np.full(MEASURES, np.nan)
        impulses, speed = frame.impulses(np.concatenate([before, row[None]]), self._speed)
        is_whole = self._speed.size or not frame.turn
        self._speed = speed
        if self._free <= 0 or not is_whole:
            return np.full(MEASURES, np.nan)
        scaled = impulses[0] / frame.spread
        total = np.zeros(len(points.radii))
        for value, column in zip(scaled.tolist(), points.columns, strict=True):
            difference = column - value
            total += difference * difference
        k = int(total.argmin())
        distance = math.sqrt(total[k])
        self._latest = scaled - points.columns[:, k], columns.turns(before)
        return np.array([distance, distance / points.radii[k]])

    def sums(self, distances: Floats, usual: Floats) -> Floats:
        """Return leaky sums of the logarithms of distances over usual ones, (6,), row by row."""
        self._t += 1
        expected = usual[min(self._t, len(usual) - 1)].tolist()
        excess = [
            min(math.log(far / near), LIMIT) if far > near else 0.0
            for far, near in zip(distances.tolist(), expected, strict=True)
        ]
        parts = itertools.product(WEIGHTS, excess)
        self._sums = [s + w * (x - s) for s, (w, x) in zip(self._sums, parts, strict=True)]
        return np.array(self._sums)

    def shares(self, sensors: int) -> Floats:
        """Return each sensor's share in the latest difference from nominal impulses, (S,)."""
        columns, spread = self._frame.columns, self._frame.spread
        shares = np.zeros(sensors)
        if self._latest is not None:
            difference, angles = self._latest
            size = len(columns.velocities)
            axes = turned(np.eye(size), waves(np.repeat(angles, size, axis=0)))
            shares[[*columns.velocities]] = (axes @ (difference * spread)[:size]) ** 2
            turn = difference[size : size + self._frame.turn]
            shares[[*columns.angles]] = (turn**2).sum() * (spread[:size] ** 2).mean()
        total = shares.sum()
        return shares / total if total > 0 else np.full(sensors, 1 / sensors)


def _speeds(angles: Floats) -> Floats:
    """Return changes of the first angle between rows, (N, K) to (N - 1,)."""
    changes: Floats = np.remainder(np.diff(angles[:, 0]) + math.pi, 2 * math.pi) - math.pi
    return changes


def _usual(distances: Floats, least: Floats) -> Floats:
    """Return the distances that are expected at each row, from those of episodes, (E, T, 2).

    A spring that comes to rest, a switch after so many rows: what happens in nominal episodes at
    one row is no event there. Rows that few episodes reach expect the least.
    """
    is_known = np.isfinite(distances)
    largest = np.where(is_known, distances, 0.0).max(axis=0)
    largest[is_known.sum(axis=0) < EPISODES] = 0.0
    padded = np.pad(largest, ((PHASE, PHASE), (0, 0)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * PHASE + 1, axis=0)
    return np.concatenate([np.maximum(windows.max(axis=-1), least), least[None]])


def _disorder(points: Floats) -> float:
    """Return the entropy of points in nats up to a constant (Kozachenko & Leonenko 1987)."""
    total = np.zeros((len(points), len(points)))
    for column in points.T:
        total += (column[:, None] - column) ** 2
    np.fill_diagonal(total, np.inf)
    floor = CLOSEST**2 * float(points.var(axis=0).mean())
    return float(0.5 * points.shape[1] * np.log(total.min(axis=1) + floor).mean())


def _successive(series: Sequence[Floats], free: Sequence[NDArray[np.bool_]]) -> float:
    """Return the correlation of successive numbers, both of them free."""
    pairs = [
        np.stack([x[:-1], x[1:]])[:, part[:-1] & part[1:]]
        for x, part in zip(series, free, strict=True)
    ]
    first, second = np.concatenate(pairs, axis=1)
    if min(first.std(), second.std()) < TINY:
        return -1.0
    return float(np.corrcoef(first, second)[0, 1])


class FrameVoice(Voice):
    """Impulses in the body's axes that are far from nominal ones, where roles say of axes.

    With actions: far from those of the same command.
    """

    name: ClassVar[str] = "frame"

    def __init__(self, panel: PanelDetector) -> None:
        self._panel = panel
        self.frame_: OwnFrame

    def fit(self, episodes: Sequence[Trajectory]) -> list[Floats]:
        """See `Voice`."""
        commands = episodes[0].actions.shape[1] if self._panel.actions else 0
        columns = Columns.of(self._panel.roles, commands)
        if columns is None:
            return []
        self.frame_ = OwnFrame(columns)
        return [x[self._panel.horizon :] for x in self.frame_.fit([*map(self._rows, episodes)])]

    def _rows(self, episode: Trajectory) -> Floats:
        """Return observations with the command before each, (T + 1, D + A)."""
        rows = episode.observations.astype(np.float64)
        if not self._panel.actions:
            return rows
        commands = np.pad(episode.actions.astype(np.float64), ((1, 0), (0, 0)))
        return np.concatenate([rows, commands], axis=1)

    def rows(self, episode: Trajectory) -> Floats:
        """See `Voice`."""
        statistic = [*map(EpisodeRun(self.frame_), self._rows(episode))]
        return np.array(statistic[self._panel.horizon :])

    def shares(self, episode: Trajectory) -> Floats:
        """See `Voice`."""
        run, shares = EpisodeRun(self.frame_), []
        for row in self._rows(episode):
            run(row)
            shares.append(run.shares(episode.observation_dim))
        return np.stack(shares[self._panel.horizon :])

    def reset(self) -> None:
        """See `Voice`."""
        self._run, self._t = EpisodeRun(self.frame_), -1

    def update(self, observation: NDArray[np.float32], action: NDArray[np.float32] | None) -> float:
        """See `Voice`."""
        self._t, self._sensors = self._t + 1, len(observation)
        row = observation.astype(np.float64)
        if commands := len(self.frame_.columns.commands):
            row = np.append(row, np.zeros(commands) if action is None else action)
        statistic = self._run(row)
        return statistic if self._t >= self._panel.horizon else math.nan

    def shares_last(self) -> Floats:
        """See `Voice`."""
        return self._run.shares(self._sensors)

    def state(self) -> State:
        """See `Voice`."""
        return {**self.frame_.arrays(), "commands": np.array(len(self.frame_.columns.commands))}

    def restore(self, state: State) -> None:
        """See `Voice`."""
        columns = Columns.of(self._panel.roles, int(take(state, "commands", (), "i")))
        if columns is None:
            raise FittedStateError("the state has a body's frame, expected roles that say of one")
        self.frame_ = OwnFrame(columns)
        self.frame_.restore(state)
        self.reset()
