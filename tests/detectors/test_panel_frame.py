"""Impulses in a body's own axes: the frame by hand, and a small body with two thrusters."""

import numpy as np
import pytest
from oodd_panel import frame as frames
from oodd_panel import make_panel
from oodd_panel.frame import Columns, OwnFrame, turned, waves

from oodd_eval import Trajectory
from oodd_eval.errors import FittedStateError
from oodd_eval.metrics.auc import auc

ROLES = ("velocity", "velocity", "angle", "contact", "measured")
GRAVITY = 0.03


def body(seed, rows=160, *, onset=None, main=1.0, side=1.0, noise=0.0):
    """Rows of a planar body: a main thruster upwards, a side thruster that also turns it.

    Velocities are in units of 2 and 1; it touches the ground in the last 20 rows.
    """
    rng = np.random.default_rng(seed)
    vx, vy, angle, speed, kept = 0.0, 0.0, rng.normal(0, 0.3), 0.0, []
    for t in range(rows):
        touches = float(t >= rows - 20)
        kept.append([vx / 2, vy, angle, touches, rng.normal()])
        later = onset is not None and t >= onset
        up = rng.uniform(0.05, 0.1) * (vy < 0) * (main if later else 1.0)
        across = -0.04 * np.sign(angle + 5 * speed) * (abs(angle + 5 * speed) > 0.15)
        across *= side if later else 1.0
        speed += 0.3 * across + (up > 0) * rng.normal(0, 0.01)
        cosine, sine = np.cos(angle), np.sin(angle)
        vx += cosine * across - sine * up + touches * rng.normal(0, 0.1)
        vy += sine * across + cosine * up - GRAVITY + touches * rng.normal(0, 0.1)
        angle += speed
    return Trajectory(np.array(kept) + noise * rng.normal(size=(rows, 5)) * [1, 1, 1, 0, 1])


@pytest.fixture(scope="module")
def train():
    return [body(i) for i in range(24)]


@pytest.fixture(scope="module")
def panel(train):
    return make_panel(forecast="linear", roles=ROLES).fit(train)


def test_columns_are_those_of_roles():
    assert Columns.of(ROLES) == Columns((0, 1), (2,), (3,), halves=False)
    halves = Columns.of(("sine", "velocity", "cosine", "velocity"))
    assert halves == Columns((1, 3), (2, 0), (), halves=True)
    assert halves.turns(np.array([[1.0, 9, 0, 9], [0, 9, -1, 9]])).ravel() == pytest.approx(
        [np.pi / 2, np.pi]
    )
    for roles in ((), ("velocity", "angle"), ("velocity",) * 2, ("velocity", "velocity", "sine")):
        assert Columns.of(roles) is None
    assert Columns.of(("velocity",) * 3 + ("angle",) * 2) is not None
    assert Columns.of(("velocity",) * 2 + ("angle",) * 2) is None


def test_vectors_are_turned_as_rotation_matrices_do():
    rng = np.random.default_rng(0)
    vectors, angles = rng.normal(size=(5, 3)), rng.normal(size=(5, 3))
    about = {
        0: lambda c, s: [[1, 0, 0], [0, c, -s], [0, s, c]],
        1: lambda c, s: [[c, 0, s], [0, 1, 0], [-s, 0, c]],
        2: lambda c, s: [[c, -s, 0], [s, c, 0], [0, 0, 1]],
    }
    for vector, angle, result in zip(vectors, angles, turned(vectors, waves(angles)), strict=True):
        roll, pitch, yaw = (np.array(about[k](np.cos(a), np.sin(a))) for k, a in enumerate(angle))
        np.testing.assert_allclose(result, (yaw @ pitch @ roll).T @ vector)
    plane = turned(vectors, waves(angles[:, :1]))
    c, s = np.cos(angles[:, 0]), np.sin(angles[:, 0])
    np.testing.assert_allclose(plane[:, 0], c * vectors[:, 0] + s * vectors[:, 1])
    np.testing.assert_allclose(plane[:, 2], vectors[:, 2])


def test_units_and_gravity_are_found_without_an_equation(train):
    frame = OwnFrame(Columns.of(ROLES))
    statistics = frame.fit([x.observations.astype(float) for x in train])
    assert [len(x) for x in statistics] == [len(x) for x in train]
    assert frame.turn
    # Velocities are known up to a common factor.
    assert frame.factors[1] / frame.factors[0] == pytest.approx(0.5, rel=0.05)
    assert frame.constant == pytest.approx([0, -GRAVITY / 2], abs=0.004)


@pytest.mark.parametrize("fault", [{"main": 0.6}, {"side": 2.0}])
def test_a_thruster_that_is_not_as_it_was_is_found(panel, fault):
    assert [*panel.voices_] == ["frame"]
    found = []
    for seed in range(100, 106):
        pair = [panel.voices(body(seed, onset=60, **f))["frame"] for f in (fault, {})]
        assert np.array_equal(*(x[:61] for x in pair), equal_nan=True)
        found.append(auc(pair[0][75:], pair[1][75:]))
    assert np.mean(found) > 0.9


def test_the_score_streams_and_is_restored(panel):
    faulty = body(200, onset=60, side=2.0)
    scores, (shares, onsets, *_) = panel.score(faulty), panel.explain(faulty)
    prefix = panel.voices(Trajectory(faulty.observations[:90]))["frame"]
    np.testing.assert_array_equal(prefix, panel.voices(faulty)["frame"][:90])
    restored = make_panel(forecast="linear", roles=ROLES)
    restored.restore(panel.state())
    np.testing.assert_array_equal(restored.score(faulty), scores)
    voice = restored.voices_["frame"]
    rows = panel.voices_["frame"].rows(faulty)
    for t, row in enumerate(faulty.observations):
        assert restored.update(row) == pytest.approx(scores[t], rel=1e-12, nan_ok=True)
        if t:
            share, onset, *_ = restored.explain_last()
            np.testing.assert_allclose(share, shares[t], atol=1e-9)
            assert onset == onsets[t]
    voice.reset()
    streamed = [voice.update(row, None) for row in faulty.observations]
    np.testing.assert_array_equal(streamed[1:], rows)
    assert np.isnan(streamed[0])
    with pytest.raises(FittedStateError):
        make_panel(forecast="linear").restore(panel.state())


def test_a_difference_is_explained_by_velocities_and_the_angle(panel):
    voice = panel.voices_["frame"]
    faulty = body(200, onset=60, side=2.0)
    shares = voice.shares(faulty)
    assert shares.shape == (len(faulty) - 1, 5)
    np.testing.assert_allclose(shares.sum(axis=1), 1)
    assert (shares[10:, 3:] == 0).all()


def test_it_is_silent_where_it_would_say_nothing(train):
    def fitted(episodes, roles=ROLES):
        return make_panel(forecast="linear", roles=roles).fit(episodes).voices_

    assert not fitted(train, ())
    assert not fitted(train[:8])  # too few episodes
    assert not fitted([body(i, noise=0.2) for i in range(24)])  # noise has no axes
    walking = [np.array(x.observations) for x in train]
    for rows in walking:
        rows[::30, 3] = 1.0  # a foot on the ground
    assert not fitted([Trajectory(rows) for rows in walking])
    assert not fitted(
        [Trajectory(x.observations * [1, 1, 1, 0, 1] + [0, 0, 0, 1, 0]) for x in train]
    )
    standing = [Trajectory(x.observations * [1, 0, 1, 1, 1]) for x in train]
    assert not fitted(standing)


def test_rows_near_a_contact_say_nothing(panel):
    rows = np.array(body(300).observations)
    rows[60, 3] = 1.0
    voice = panel.voices_["frame"]
    moved = rows.copy()
    moved[60 : 60 + frames.REST, 0] += np.linspace(0, 3, frames.REST)
    moved[60 + frames.REST :, 0] += 3
    still, shifted = (voice.rows(Trajectory(x)) for x in (rows, moved))
    np.testing.assert_array_equal(still[: 59 + frames.REST], shifted[: 59 + frames.REST])


def test_with_actions_an_impulse_has_to_be_that_of_its_command():
    """Nominal impulses at the wrong commands are odd, and only with actions."""
    train = []
    for seed in range(24):
        x = body(seed)
        fires = np.diff(x.observations[:, 1]) > -GRAVITY / 2
        train.append(Trajectory(x.observations, np.eye(2)[fires.astype(int)]))
    panels = [
        make_panel(name, forecast="linear", roles=ROLES).fit(train) for name in ("panel", "panel-a")
    ]
    wrong = np.array(train[0].actions)
    wrong[60:90] = wrong[60:90, ::-1]
    swapped = Trajectory(train[0].observations, wrong)
    for panel, differs in zip(panels, (False, True), strict=True):
        voice = panel.voices_["frame"]
        plain, other = voice.rows(train[0]), voice.rows(swapped)
        assert np.array_equal(plain[:60], other[:60])
        assert (other[60:90].max() > 3 * plain.max()) == differs
        restored = make_panel(panel.name, forecast="linear", roles=ROLES)
        restored.restore(panel.state())
        commands = [None, *wrong]
        live = restored.voices_["frame"]
        live.reset()
        streamed = [live.update(*x) for x in zip(swapped.observations, commands, strict=True)]
        np.testing.assert_array_equal(streamed[1:], other)
