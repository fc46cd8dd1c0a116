"""The identity of results: which detector setting was evaluated, and on which cell.

A `Setting` is a row of a board. A `Cell` is one evaluation: split x environment x anomaly x setting
x seed. Their texts are written here and nowhere else. The device that computed a result
is no part of its identity.
"""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from oodd_eval.data.condition import Condition
from oodd_eval.errors import UsageError

# A text value that needs quotes: it would be read as JSON, or holds what separates values.
_QUOTED = re.compile(r"[\[\]{},=\"\s]|^$")


ROLLING: Final = "rolling"
"""Word by which the text of a setting tells that its calibration is a rolling one."""


@dataclass(frozen=True, slots=True)
class Setting:
    """A detector with its horizon and the parameters that are not at their default.

    Parameters
    ----------
    detector
        Name of the detector.
    horizon
        Prediction horizon in steps.
    parameters
        The parameters that differ from their default, sorted by name; values are JSON texts, so
        that settings can be dictionary keys.
    rolling
        Whether nominal test episodes join the calibration of its alarms (`rolling_rules`).

    Examples
    --------
    >>> str(Setting.of("riqn", 5, {"updates": 2400}))
    'riqn[h=5,updates=2400]'
    >>> str(Setting("rf"))
    'rf'
    """

    detector: str
    horizon: int = 1
    parameters: tuple[tuple[str, str], ...] = ()
    rolling: bool = False

    @classmethod
    def of(
        cls,
        detector: str,
        horizon: int = 1,
        overrides: Mapping[str, Any] | None = None,
        *,
        rolling: bool = False,
    ) -> "Setting":
        """Make a setting from a mapping of the parameters that are not at their default.

        Parameters
        ----------
        detector, horizon, rolling
            As those of the class.
        overrides
            Values by name.

        Returns
        -------
        Setting
        """
        items = sorted((overrides or {}).items())
        texts = ((k, json.dumps(value, sort_keys=True, default=str)) for k, value in items)
        return cls(detector, horizon, tuple(texts), rolling)

    @property
    def overrides_json(self) -> str:
        """The parameters that are not at their default, as one JSON object."""
        return json.dumps(self.overrides, sort_keys=True)

    @property
    def overrides(self) -> dict[str, Any]:
        """The parameters that are not at their default, by name."""
        return {name: json.loads(text) for name, text in self.parameters}

    def __str__(self) -> str:
        """Return the detector's name with all that is not a default."""
        horizon = {"h": self.horizon} if self.horizon != 1 else {}
        return _bracketed(self.detector, horizon | self.overrides | self._calibration)

    @classmethod
    def parse(cls, text: str) -> "Setting":
        """Read what `str` writes; a text of another form raises `UsageError`.

        >>> Setting.parse("riqn[h=5,updates=2400]") == Setting.of("riqn", 5, {"updates": 2400})
        True
        """
        # Behind a colon a name may have brackets of its own: column:innov[0][h=5].
        match = re.fullmatch(r"([^\[:]+|[^\[:]+:.+?)(?:\[(\w+=.*|)\])?", text)
        settings = _read_settings(match[2] or "") if match else None
        if match is None or settings is None:
            raise UsageError(f"{text!r} is no setting: expected DETECTOR[h=N,NAME=VALUE,...]")
        rolling = settings.pop(ROLLING, False) is True
        return cls.of(match[1], settings.pop("h", 1), settings, rolling=rolling)

    def label(self, seed: int) -> str:
        """Return the right-hand side of a cell's text, such as ``riqn[h=1,seed=0]``."""
        settings = {"h": self.horizon, "seed": seed, **self.overrides, **self._calibration}
        return _bracketed(self.detector, settings)

    @property
    def _calibration(self) -> dict[str, bool]:
        return {ROLLING: True} if self.rolling else {}


@dataclass(frozen=True, slots=True)
class Cell:
    """One evaluation.

    Parameters
    ----------
    split, environment
        Names. A split that is not the published one carries the start of its digest: ``mini@0a1b``.
    condition
        The anomaly at its strength.
    setting
        The detector.
    seed
        Seed of the detector.

    Examples
    --------
    >>> cell = Cell("mini", "hopper", Condition("iid"), Setting("riqn"), seed=0)
    >>> str(cell)
    'mini/hopper/iid::riqn[h=1,seed=0]'
    """

    split: str
    environment: str
    condition: Condition
    setting: Setting
    seed: int = 0

    def __str__(self) -> str:
        """Return the text that is printed and that ``-k`` matches."""
        return f"{self.split}/{self.environment}/{self.condition}::{self.label}"

    @property
    def label(self) -> str:
        """Setting and seed, such as ``riqn[h=1,seed=0]``."""
        return self.setting.label(self.seed)


def _bracketed(detector: str, settings: Mapping[str, Any]) -> str:
    text = ",".join(f"{name}={_text(value)}" for name, value in settings.items())
    return f"{detector}[{text}]" if text else detector


def _text(value: Any) -> str:
    """Return a value as JSON, or a plain text without quotes where that reads back as the same."""
    if isinstance(value, str) and not _QUOTED.search(value) and _read(value) == value:
        return value
    return json.dumps(value, default=str)


def _read(text: str) -> Any:
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text


def _read_settings(text: str) -> dict[str, Any] | None:
    """Return names and values of a list ``a=1,b="x,y",c=[1,2]``; None when it is none."""
    settings: dict[str, Any] = {}
    decoder = json.JSONDecoder()
    position = 0
    while position < len(text):
        name, equals, rest = text[position:].partition("=")
        if not equals:
            return None
        plain, _, _ = rest.partition(",")
        end = len(plain)
        settings[name] = _read(plain)
        if rest[:1] in '["{':
            try:
                settings[name], end = decoder.raw_decode(rest)
            except json.JSONDecodeError:
                return None
        position += len(name) + 1 + end + 1
    return settings
