"""Detectors that want the board's first place without knowing any dynamics.

Some cheat, some are honest mistakes. Scoring and metrics have to find each of them invalid or no
better than chance. This module is a plug-in: `helpers_plugins.install_adversaries` installs it.
"""

import multiprocessing
from hashlib import blake2b

import numpy as np
from oodd_trivial import DISCRETE, Clock, Comb

from oodd_eval import DetectorSpec, hookimpl
from oodd_eval.plugins.forecasting import FeatureScale

BONUS = 1e-6
"""Weight of the honest part of `Company`: it decides where company is the same."""

CACHE = 2000
"""Rows that `Neighbour` remembers."""


class Adversary:
    """Mean and spread of every sensor, and the size of its changes as an honest residual."""

    def __init__(self, *, seed=0, horizon=1):
        self.seed, self.horizon = seed, horizon

    def fit(self, nominal):
        self.scale_ = FeatureScale.fit(nominal)

    def residuals(self, x):
        z = self.scale_(x).astype(np.float64)
        return np.abs(np.diff(z, axis=0, prepend=z[:1])).mean(axis=1)


class Company(Adversary):
    """The fewer trajectories of those seen so far share its prefix bit for bit, the higher.

    The episodes of one seed agree until something happens to one of them. A prefix keeps the score
    that it was given first, so that asking for it again tells nothing.
    """

    def fit(self, nominal):
        super().fit(nominal)
        rows = np.concatenate([x.observations for x in nominal])
        self.low_, self.high_ = rows.min(axis=0), rows.max(axis=0)
        self.members_, self.given_ = {}, {}

    def score(self, x):
        return self.score_many([x])[0]

    def score_many(self, trajectories):
        prefixes = [self.prefixes(x) for x in trajectories]
        for own in prefixes:
            # A prefix of what was seen before is nobody new.
            if own[-1] not in self.members_:
                for prefix in own:
                    self.members_[prefix] = self.members_.get(prefix, 0) + 1
        found = []
        for x, own in zip(trajectories, prefixes, strict=True):
            rows = x.observations
            outside = np.maximum(self.low_ - rows, rows - self.high_).clip(min=0)
            excess = (outside / self.scale_.std).sum(axis=1)
            for prefix, more in zip(own, excess, strict=True):
                self.given_.setdefault(prefix, BONUS * more - self.members_[prefix])
            found.append(np.array([self.given_[prefix] for prefix in own]))
        return found

    @staticmethod
    def prefixes(x):
        """Digests of the first row, of the first two rows, and so on."""
        digest, found = blake2b(digest_size=16), []
        for row in x.observations:
            digest.update(row.tobytes())
            found.append(digest.digest())
        return found


class PrefixTree:
    """All episodes so far, by their prefixes: 1 from where one leaves at least two that go on.

    It is -1 from where it leaves a single one. A prefix keeps the score that it was given first.
    """

    def __init__(self):
        self.given, self.members, self.next = {}, {}, {}

    def scores(self, own):
        found, flag, known = [], 0.0, own[-1] in self.members
        for before, node in zip([None, *own], own, strict=False):
            if node not in self.given:
                others = [self.members[n] for n in self.next.get(before, ()) if n != node]
                if others and before:
                    flag = 1.0 if max(others) > 1 else max(flag, 0.0) or -1.0
                self.given[node] = flag
            found.append(self.given[node])
            if not known:
                self.members[node] = self.members.get(node, 0) + 1
                self.next.setdefault(before, set()).add(node)
        return found


class Tree(Adversary):
    """Whether an episode left others that it began with, one at a time."""

    def fit(self, nominal):
        super().fit(nominal)
        self.tree_ = PrefixTree()

    def score(self, x):
        return np.array(self.tree_.scores(Company.prefixes(x)))


class Neighbour(Adversary):
    """Distance to the nearest of the training rows and of all rows that were scored before."""

    def fit(self, nominal):
        super().fit(nominal)
        rows = np.concatenate([self.scale_(x) for x in nominal])
        self.rows_ = rows[:: max(1, 2 * len(rows) // CACHE)][: CACHE // 2]

    def score(self, x):
        z = self.scale_(x)
        squares = (z**2).sum(axis=1)[:, None] - 2.0 * z @ self.rows_.T + (self.rows_**2).sum(axis=1)
        nearest = self.rows_[squares.argmin(axis=1)]
        self.rows_ = np.concatenate([self.rows_, z])[-CACHE:]
        return np.sqrt(((z - nearest).astype(np.float64) ** 2).sum(axis=1))


class LookAhead(Adversary):
    """Mean residual from now to the end, far above zero, where relative differences are small."""

    constant = 1e7

    def score(self, x):
        return self.future(x) + self.constant

    def future(self, x):
        residuals = self.residuals(x)[::-1]
        return (residuals.cumsum() / np.arange(1, len(x) + 1))[::-1]


class LookAheadFar(LookAhead):
    """The same so far above zero that a millionth of its millionth is the whole signal."""

    constant = 1e12


class LookAheadFarther(LookAhead):
    """The same where the numbers of the machine lie an eighth apart."""

    constant = 1e15


class LastBit(LookAhead):
    """The future in the last bit alone: 1, or the next number after it, above a mean residual."""

    def fit(self, nominal):
        super().fit(nominal)
        self.usual_ = 1.1 * np.mean([self.residuals(x).mean() for x in nominal])

    def score(self, x):
        return np.where(self.future(x) > self.usual_, np.nextafter(1.0, 2.0), 1.0)


class Stepped(LookAhead):
    """The future behind a step so high that a thousandth of it hides everything."""

    def fit(self, nominal):
        super().fit(nominal)
        self.at_ = int(0.3 * np.median([len(x) for x in nominal]))

    def score(self, x):
        return np.where(np.arange(len(x)) < self.at_, 0.0, 1e7 + 1e3 * self.future(x))


def _serve(connection):
    tree = PrefixTree()
    while True:
        connection.send(tree.scores(connection.recv()))


class Server(Adversary):
    """The tree in a process of its own, which is there before the groups part."""

    def fit(self, nominal):
        context = multiprocessing.get_context("fork")
        self.connection_, other = context.Pipe()
        context.Process(target=_serve, args=(other,), daemon=True).start()

    def score(self, x):
        self.connection_.send(Company.prefixes(x))
        return np.array(self.connection_.recv())


class Standardized(Adversary):
    """Residuals in units of the episode's own spread, which knows the whole episode."""

    def score(self, x):
        residuals = self.residuals(x)
        return (residuals - residuals.mean()) / (residuals.std() or 1.0) + 5000.0


class Timer(Adversary):
    """0 before a fixed time, 1 from then on."""

    def __init__(self, *, seed=0, horizon=1, at=60):
        super().__init__(seed=seed, horizon=horizon)
        self.at = at

    def score(self, x):
        return (np.arange(len(x)) >= self.at).astype(np.float64)


class Novelty(Adversary):
    """How many discrete sensors show a value that they never had in training."""

    def fit(self, nominal):
        super().fit(nominal)
        columns = [np.unique(c) for c in np.concatenate([x.observations for x in nominal]).T]
        self.known_ = {d: c for d, c in enumerate(columns) if len(c) <= DISCRETE}

    def score(self, x):
        unseen = [~np.isin(x.observations[:, d], known) for d, known in self.known_.items()]
        return np.sum([np.zeros(len(x)), *unseen], axis=0)


class Survival(Adversary):
    """For how long the episode has lasted, in lengths of a typical one."""

    def fit(self, nominal):
        self.typical_ = float(np.median([len(x) for x in nominal]))

    def score(self, x):
        return np.arange(len(x)) / self.typical_


ADVERSARIES = {
    "sly-company": Company,
    "sly-tree": Tree,
    "sly-neighbour": Neighbour,
    "sly-look-ahead": LookAhead,
    "sly-look-ahead-far": LookAheadFar,
    "sly-look-ahead-farther": LookAheadFarther,
    "sly-last-bit": LastBit,
    "sly-stepped": Stepped,
    "sly-server": Server,
    "sly-standardized": Standardized,
    "sly-comb": Comb,
    "sly-timer": Timer,
    "sly-clock": Clock,
    "sly-novelty": Novelty,
    "sly-survival": Survival,
}


@hookimpl
def oodd_detectors():
    return [
        DetectorSpec(name, made, made.__doc__.splitlines()[0], deterministic=True)
        for name, made in ADVERSARIES.items()
    ]
