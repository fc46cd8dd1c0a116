"""Forecasts of the torch ensembles in a slow, obvious loop: the oracle of tests."""

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
