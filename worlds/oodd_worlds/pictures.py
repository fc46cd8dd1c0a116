"""Drawings of the worlds, made from their facts: plain SVG, without a renderer."""

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from oodd_recording.svg import INK, label, svg

from oodd_worlds.facts import World, read_world

GREY, PALE, BLUE, ORANGE, WATER = "#777777", "#dddddd", "#0072b2", "#d55e00", "#a6cee3"

Point = tuple[float, float]


def _line(points: Iterable[Point], colour: str = INK, width: float = 2) -> str:
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polyline points="{path}" stroke="{colour}" stroke-width="{width:g}"/>'


def _circle(centre: Point, radius: float, fill: str = "white", colour: str = INK) -> str:
    x, y = centre
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}" fill="{fill}" stroke="{colour}"/>'


def _arrow(start: Point, end: Point, colour: str = INK) -> str:
    """Return a line with a head at its end."""
    along = math.atan2(end[1] - start[1], end[0] - start[0])
    barbs = [
        (end[0] - 8 * math.cos(along + turn), end[1] - 8 * math.sin(along + turn))
        for turn in (-0.45, 0.45)
    ]
    return _line([start, end], colour) + _line([barbs[0], end, barbs[1]], colour)


# The arm

_ARM_SCALE: Final = 380.0  # pixels a metre


def link_frames(world: World, angles: Sequence[float]) -> list[NDArray[np.float64]]:
    """Return the frame of the base and that of each link, of shape (4, 4), at the joints' angles.

    Frame i is frame i - 1, turned by the joint's angle about z, moved by d along z and by a along
    the new x, and turned by alpha about that.
    """
    frames = [np.eye(4)]
    rows = zip(angles, *(world.value(name) for name in ("a", "d", "alpha")), strict=True)
    for angle, a, d, alpha in rows:
        c, s, ca, sa = math.cos(angle), math.sin(angle), math.cos(alpha), math.sin(alpha)
        step = [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d]]
        frames.append(frames[-1] @ np.array([*step, [0, 0, 0, 1]]))
    return frames


def picture_arm() -> str:
    """Return a drawing of the arm at home, from the side and from above."""
    from oodd_worlds.arm import HOME  # noqa: PLC0415  imports the simulator

    world = read_world("arm")
    frames, d = link_frames(world, HOME), world.value("d")
    way = [frames[0][:3, 3]]
    for i, (before, after) in enumerate(itertools.pairwise(frames)):
        way += [before[:3, 3] + d[i] * before[:3, 2], after[:3, 3]]
    load = (frames[-1] @ [0.0, 0.0, world.value("payload offset"), 1.0])[:3]
    shapes = [label(20, 22, "UR5e at home", "start", "bold")]
    for title, origin, axis, name in (
        ("from the side", (290.0, 330.0), 2, "z"),
        ("from above", (600.0, 230.0), 1, "y"),
    ):

        def seen(point: NDArray[np.float64], origin: Point = origin, axis: int = axis) -> Point:
            x, y = origin
            return x + _ARM_SCALE * float(point[0]), y - _ARM_SCALE * float(point[axis])

        shapes += [label(origin[0] - 120, 356, title), *_axes(origin, name)]
        if axis == 2:
            shapes.append(_line([(20, origin[1]), (origin[0] + 40, origin[1])], GREY, 1))
        shapes += [_line(map(seen, way), GREY, 7), _line(map(seen, [way[-1], load]), GREY, 3)]
        x, y = seen(load)
        shapes += [_circle((x, y), 7, ORANGE), label(x, y + 22, "payload")]
        shapes += _joints([seen(frame[:3, 3]) for frame in frames[:-1]])
    bar = 0.2 * _ARM_SCALE
    shapes += [_line([(20, 50), (20 + bar, 50)]), label(26 + bar, 54, "0.2 m", "start")]
    return svg(680, 370, shapes)


def _axes(origin: Point, name: str) -> Iterator[str]:
    """Return arrows along x and another axis, beside the base."""
    x, y = origin[0] + 24, origin[1] - 8 if name == "z" else origin[1] + 60
    yield _arrow((x, y), (x + 30, y), BLUE)
    yield _arrow((x, y), (x, y - 30), BLUE)
    yield label(x + 38, y + 4, "x")
    yield label(x + 8, y - 24, name, "start")


def _joints(points: Sequence[Point]) -> Iterator[str]:
    """Return a circle for each joint, with the numbers of all that lie there."""
    numbers: dict[tuple[int, int], list[int]] = {}
    for i, (x, y) in enumerate(points):
        numbers.setdefault((round(x), round(y)), []).append(i + 1)
    for (x, y), joints in numbers.items():
        yield _circle((x, y), 6)
        yield label(x + 10, y - 10, ", ".join(map(str, joints)), "start")


# The drone

_DRONE_SCALE: Final = 560.0  # pixels a metre
_ROTOR: Final = 0.1  # m, radius of a drawn rotor: nothing depends on it


def picture_drone() -> str:
    """Return a drawing of the drone, from above and from the side."""
    from oodd_worlds.drone import SPINS  # noqa: PLC0415  imports the simulator

    world = read_world("drone")
    arm, radius = _DRONE_SCALE * world.value("arm"), _DRONE_SCALE * _ROTOR
    middle = 180.0, 200.0
    shapes = [label(20, 22, "AscTec Hummingbird", "start", "bold"), label(180, 386, "from above")]
    for i, (right, up) in enumerate(((1, 0), (0, 1), (-1, 0), (0, -1))):
        hub = middle[0] + arm * right, middle[1] - arm * up
        shapes += [_line([middle, hub], GREY, 5), _circle(hub, radius, "none", GREY)]
        # The air turns the body against the rotor: a positive torque is a clockwise rotor's.
        shapes += [_turning(hub, 0.7 * radius, clockwise=SPINS[i] > 0), _circle(hub, 4, INK)]
        shapes.append(label(hub[0] - 12, hub[1] - 8, f"{i + 1}", weight="bold"))
    start = 30.0, 340.0
    shapes += [_arrow(start, (70, 340), BLUE), _arrow(start, (30, 300), BLUE)]
    shapes += [label(78, 344, "x"), label(30, 294, "y")]
    ground, height = 500.0, 200.0
    shapes.append(label(ground, 386, "from the side"))
    shapes.append(_line([(ground - arm, height), (ground + arm, height)], GREY, 5))
    shapes.append(_line([(ground - 22, height + 6), (ground + 22, height + 6)], INK, 12))
    for x, number in ((ground - arm, "3"), (ground, "2, 4"), (ground + arm, "1")):
        if number != "2, 4":
            shapes.append(_line([(x, height), (x, height - 14)], GREY, 3))
            shapes.append(_line([(x - radius, height - 14), (x + radius, height - 14)], INK, 2))
        shapes += [_arrow((x, height - 20), (x, height - 75), ORANGE)]
        shapes.append(label(x, height - 82, f"thrust {number}"))
    weight = world.value("mass") * world.value("gravity")
    shapes.append(_arrow((ground, height + 14), (ground, height + 80), ORANGE))
    shapes.append(label(ground, height + 96, f"weight {weight:.2f} N"))
    ruler = height + 126
    shapes.append(_line([(ground, ruler), (ground + arm, ruler)], BLUE, 1))
    shapes += [_line([(x, ruler - 6), (x, ruler + 6)], BLUE, 1) for x in (ground, ground + arm)]
    shapes.append(label(ground + arm / 2, ruler + 18, f"{world.value('arm'):g} m"))
    return svg(670, 400, shapes)


def _turning(centre: Point, radius: float, *, clockwise: bool) -> str:
    """Return three quarters of a circle with a head at its end."""
    x, y = centre
    side = 1 if clockwise else -1  # the picture's y axis points down
    arc = [
        (x + radius * math.sin(side * t), y - radius * math.cos(side * t))
        for t in np.linspace(0.5, 4.5, 30).tolist()
    ]
    return _line(arc, BLUE) + _arrow(arc[-2], arc[-1], BLUE)


# The tank

_TANK_SCALE: Final = 5.5  # pixels a centimetre of height
_WIDTH_SCALE: Final = 3.0  # pixels a square centimetre of area


def picture_tank() -> str:
    """Return a scheme of tanks, pumps and valves, with the levels at rest at three volts."""
    from oodd_worlds.tank import Tank, steady_levels  # noqa: PLC0415  slow to import

    world = read_world("tank")
    area, orifice, split = (world.value(name) for name in ("area", "orifice", "split"))
    gain, height = world.value("pump gain"), _TANK_SCALE * world.value("height")
    levels = steady_levels(Tank(), [3.0, 3.0])
    middles, bottoms = (190.0, 370.0, 190.0, 370.0), (350.0, 350.0, 190.0, 190.0)
    ground, valve = 420.0, 222.0
    shapes = [label(20, 22, "Quadruple tank at 3 V", "start", "bold")]
    # Of each pump: the colour of its pipe, its place and height, and where it ends above the upper
    # tank of the other side and above its own lower tank.
    pipes = (
        (BLUE, 70.0, 58.0, middles[1] + 20, middles[0] - 20),
        (ORANGE, 490.0, 42.0, middles[0] - 20, middles[1] + 20),
    )
    for i, (colour, x, top, far, near) in enumerate(pipes):
        outwards, anchor = (-1, "end") if i == 0 else (1, "start")
        shapes += [
            _line([(x, ground), (x, top), (far, top)], *pen) for pen in (("white", 7), (colour,))
        ]
        shapes += [
            _arrow((far, top), (far, bottoms[2] - height - 6), colour),
            _line([(x, valve), (near, valve)], colour),
        ]
        shapes.append(_arrow((near, valve), (near, bottoms[0] - height - 6), colour))
        shapes.append(
            _line(
                (x + 9 * u, valve + 9 * v)
                for u, v in ((-1, -1), (1, 1), (1, -1), (-1, 1), (-1, -1))
            )
        )
        shapes.append(label(x + 14 * outwards, valve - 2, f"{split[i]:g}", anchor))
        shapes.append(label(x + 12 * outwards, valve - 26, f"{1 - split[i]:g}", anchor))
        shapes += [_circle((x, ground - 30), 17), label(x, ground - 26, f"{i + 1}", weight="bold")]
        shapes.append(label(x, ground + 40, f"pump {i + 1}: {gain[i]:g} cm³/(V s)"))
    for i, (x, bottom) in enumerate(zip(middles, bottoms, strict=True)):
        half, deep = _WIDTH_SCALE * float(area[i]) / 2, _TANK_SCALE * levels[i]
        shapes.append(
            f'<rect x="{x - half:.1f}" y="{bottom - deep:.1f}" width="{2 * half:.1f}" '
            f'height="{deep:.1f}" fill="{WATER}"/>'
        )
        sides, middle = (x - half, x + half), bottom - height / 2
        below = ground if i < 2 else bottoms[i - 2] - height + 8
        shapes.append(
            _line(
                [
                    (sides[0], bottom - height),
                    *((s, bottom) for s in sides),
                    (sides[1], bottom - height),
                ]
            )
        )
        shapes.append(_arrow((x, bottom), (x, below), GREY))
        shapes.append(label(x, middle - 14, f"tank {i + 1}", weight="bold"))
        shapes.append(label(x, middle + 4, f"{area[i]:g} cm²"))
        shapes.append(label(x, middle + 20, f"{levels[i]:.1f} cm"))
        shapes.append(label(x + 8, bottom + 16, f"{orifice[i]:g} cm²", "start"))
    shapes += [_line([(40, ground), (40, ground + 18), (520, ground + 18), (520, ground)])]
    return svg(560, 475, shapes)
