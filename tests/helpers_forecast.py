"""Forecasts of the torch ensembles in a slow, obvious loop: the oracle of tests and benchmarks."""

import numpy as np
import torch
from oodd_torch.forecast import quantile_levels
from oodd_torch.network import GRID


def slow_errors(made, rows, *, horizon, samples, mean_sampling, seed):
    """The obvious way: one trajectory, one time, one member, one sample after the other."""
    a = made.architecture
    errors = []
    for t in range(horizon, len(rows)):
        levels = quantile_levels(seed, range(t, t + 1), horizon, made.members, samples, a.features)
        total = 0.0
        for e in range(made.members):
            streams = [list(rows[: t - horizon + 1]) for _ in range(samples)]
            for k in range(horizon):
                following = []
                for m in range(samples):
                    index = levels[0, k, e, m] if a.quantiles else None
                    following.append(one_step(made, e, streams[m], index))
                if mean_sampling and k < horizon - 1:
                    following = [np.mean(following, axis=0)] * samples
                for stream, row in zip(streams, following, strict=True):
                    stream.append(row)
            total += np.mean([np.abs(rows[t] - s[-1]) for s in streams])
        errors.append(total / made.members)
    return np.array(errors)


def one_step(made, e, stream, index):
    d = made.architecture.features
    if made.architecture.per_feature:  # one network after the other, each for its own sensor
        change = [change_of(made, e * d + i, stream, index, [i])[0] for i in range(d)]
    else:
        change = change_of(made, e, stream, index, range(d))
    w = made.architecture.window
    past = np.concatenate([stream[max(len(stream) - 1 - i, 0)] for i in range(w)])
    return linear(made, past) + made.unit.numpy() * np.array(change, np.float32)


def linear(made, past):
    return past @ made.base[:-1].numpy() + made.base[-1].numpy()


def change_of(made, network, stream, index, sensors):
    a, h = made.architecture, made.architecture.units
    p = {n: p[network] for n, p in made.named_parameters()}

    def dense(x, name):
        return x @ p[name] + p[f"{name}_bias"][0]

    memory = torch.zeros(h)
    for t in range(len(stream)):
        past = [stream[max(t - w, 0)] for w in range(a.window)]
        f = torch.relu(dense(torch.tensor(np.concatenate(past)), "first"))
        if not a.recurrent:
            memory = f
            continue
        gates, recurrent = dense(f, "gru_in"), dense(memory, "gru")
        reset = torch.sigmoid(gates[:h] + recurrent[:h])
        update = torch.sigmoid(gates[h : 2 * h] + recurrent[h : 2 * h])
        candidate = torch.tanh(gates[2 * h :] + reset * recurrent[2 * h :])
        memory = (1 - update) * candidate + update * memory
    z = torch.relu(dense(memory, "second")) + f
    out = []
    for column, d in enumerate(sensors):
        phi = torch.ones(h)
        if index is not None:
            tau = (index[d] + 0.5) / GRID
            phi = torch.relu(dense(torch.cos(torch.pi * torch.arange(a.cosines) * tau), "cosine"))
        out.append(float((z * phi) @ p["out"][:, column] + p["out_bias"][0, column]))
    return out


class Walker:
    """The slow loop as it would run on a robot: memory carried along, one step at a time.

    Every member and every sample is a pass of its own over single vectors, and the cosine embedding
    is computed anew for each.
    """

    def __init__(self, made, *, horizon, samples, mean_sampling, seed):
        if mean_sampling or made.architecture.per_feature or made.architecture.window > 1:
            raise ValueError("the walker knows riqn with a shared trunk only")
        self.made, self.horizon, self.samples, self.seed = made, horizon, samples, seed
        self.weights = [{n: p[e] for n, p in made.named_parameters()} for e in range(made.members)]

    def errors(self, rows, count):
        """Return the first `count` errors of a trajectory of standardized observations."""
        a, h = self.made.architecture, self.horizon
        rows = torch.tensor(rows)
        memories = [torch.zeros(a.units) for _ in self.weights]
        found = []
        for t in range(count):
            drawn = quantile_levels(
                self.seed, range(t + h, t + h + 1), h, len(self.weights), self.samples, a.features
            )
            total = 0.0
            for e, p in enumerate(self.weights):
                newest = rows[t]
                f, memories[e] = gru_step(p, newest, memories[e])
                for m in range(self.samples):
                    o, g, memory = newest, f, memories[e]
                    for k in range(h):
                        if k:
                            g, memory = gru_step(p, o, memory)
                        linear = o @ self.made.base[:-1] + self.made.base[-1]
                        o = linear + self.made.unit * change(p, g, memory, drawn[0, k, e, m])
                    total += float((rows[t + h] - o).abs().mean())
            found.append(total / len(self.weights) / self.samples)
        return np.array(found)


def gru_step(p, observation, memory):
    h = len(memory)
    f = torch.relu(observation @ p["first"] + p["first_bias"][0])
    gates, recurrent = f @ p["gru_in"] + p["gru_in_bias"][0], memory @ p["gru"] + p["gru_bias"][0]
    reset = torch.sigmoid(gates[:h] + recurrent[:h])
    update = torch.sigmoid(gates[h : 2 * h] + recurrent[h : 2 * h])
    candidate = torch.tanh(gates[2 * h :] + reset * recurrent[2 * h :])
    return f, (1 - update) * candidate + update * memory


def change(p, f, memory, index):
    z = torch.relu(memory @ p["second"] + p["second_bias"][0]) + f
    tau = (torch.from_numpy(index.astype(np.float32))[:, None] + 0.5) / GRID
    cosines = torch.cos(torch.pi * torch.arange(len(p["cosine"])) * tau)
    phi = torch.relu(cosines @ p["cosine"] + p["cosine_bias"][0])  # (D, H)
    return ((z * phi) * p["out"].T).sum(1) + p["out_bias"][0]
