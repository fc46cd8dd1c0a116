"""An LSTM autoencoder of windows, for comparison in log_rows.py; no row of the boards.

After Malhotra et al. 2016 (LSTM-based encoder-decoder for multi-sensor anomaly detection): one LSTM
reads a window, another writes it backwards from the state that the first ends with. PyOD's LSTMAD
is a forecaster, and its AutoEncoder knows single rows. Made causal: the score of a row is its error
in the window that ends with it.
"""

from dataclasses import dataclass

import numpy as np
import torch

STD_FLOOR, LIMIT = 1e-6, 30.0


class Autoencoder(torch.nn.Module):
    """Two LSTMs of one layer, and a linear map to the sensors."""

    def __init__(self, sensors, hidden):
        super().__init__()
        self.encoder = torch.nn.LSTM(sensors, hidden, batch_first=True)
        self.decoder = torch.nn.LSTM(sensors, hidden, batch_first=True)
        self.out = torch.nn.Linear(hidden, sensors)

    def forward(self, x):
        """Return windows (B, W, D) backwards, each row written with the row after it at hand."""
        _, (h, c) = self.encoder(x)
        last = self.out(h[0])[:, None]
        known = torch.flip(x, (1,))[:, :-1]
        return torch.cat([last, self.out(self.decoder(known, (h, c))[0])], dim=1)


@dataclass
class LstmAutoencoder:
    """Detector whose score is the root mean square error of the newest row of a window."""

    window: int = 20
    hidden: int = 16
    updates: int = 300
    rate: float = 5e-3
    batch: int = 64
    seed: int = 0

    def fit(self, nominal):
        """Fit to the windows of nominal episodes of which at least half is recorded."""
        torch.manual_seed(self.seed)
        rng = np.random.default_rng(self.seed)
        rows = np.concatenate([x.observations for x in nominal]).astype(np.float64)
        self.mean, std = rows.mean(axis=0), rows.std(axis=0)
        self.std = np.where(std < STD_FLOOR, 1.0, std)
        windows = torch.cat([self._windows(x)[min(self.window, len(x)) // 2 :] for x in nominal])
        self.net = Autoencoder(rows.shape[1], self.hidden)
        optimizer = torch.optim.Adam(self.net.parameters(), self.rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, self.updates)
        for _ in range(self.updates):
            x = windows[rng.integers(len(windows), size=self.batch)]
            loss = ((self.net(x) - torch.flip(x, (1,))) ** 2).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
        return self

    @torch.no_grad()
    def score(self, trajectory):
        """Return the error of each row, one a row."""
        windows = self._windows(trajectory)
        errors = [
            ((self.net(x)[:, 0] - x[:, -1]) ** 2).mean(dim=1) for x in torch.split(windows, 1024)
        ]
        return torch.cat(errors).sqrt().double().numpy()

    def _windows(self, trajectory):
        """Return the window that ends with each row; what was before the first row is like it."""
        rows = np.clip((trajectory.observations - self.mean) / self.std, -LIMIT, LIMIT)
        padded = np.concatenate([np.repeat(rows[:1], self.window - 1, axis=0), rows])
        cut = np.lib.stride_tricks.sliding_window_view(padded, self.window, axis=0)
        return torch.from_numpy(np.ascontiguousarray(cut.transpose(0, 2, 1), dtype=np.float32))
