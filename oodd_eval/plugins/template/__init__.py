"""A ready plug-in project: what ``oodd-eval new`` writes.

Templates lie beside this module, each ending in ``.in`` so that nothing takes them for source of
this package. `FILES` says where each goes; ``@NAME@`` and the like stand for the names of the
project, in paths and in contents.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Final

from oodd_eval.errors import OutputError, UsageError

FILES: Final[Mapping[str, str]] = {
    "pyproject.toml": "pyproject.toml.in",
    "README.md": "readme.md.in",
    ".gitignore": "gitignore.in",
    ".github/workflows/ci.yml": "ci.yml.in",
    "src/@MODULE@/__init__.py": "plugin.py.in",
    "src/@MODULE@/detector.py": "detector.py.in",
    "src/@MODULE@/py.typed": "py.typed.in",
    "tests/test_detector.py": "test.py.in",
}
"""Path in the project and template, in the order in which they are told."""

LONGEST: Final = 30
"""Characters of a name, at most: what keeps the lines of the templates within their limit."""

RESERVED: Final = ("all", "eval")
"""``all`` selects every detector, and ``oodd-eval`` is this distribution."""


@dataclass(frozen=True, slots=True)
class Project:
    """The names of a plug-in project.

    Parameters
    ----------
    name
        Of the detector: lower-case letters, digits and hyphens.

    Raises
    ------
    UsageError
        When the name is no name of a detector, with one that would be.

    Examples
    --------
    >>> project = Project("slow-drift")
    >>> project.distribution, project.module, project.class_name
    ('oodd-slow-drift', 'oodd_slow_drift', 'SlowDrift')
    """

    name: str

    def __post_init__(self) -> None:
        if self.name in RESERVED:
            raise UsageError(f"{self.name!r} means something else: choose another name")
        if not _is_name(self.name):
            close = _tidy(self.name)
            hint = f"; did you mean {close!r}?" if _is_name(close) else ""
            raise UsageError(
                f"{self.name!r} is no name for a detector: expected lower-case letters, digits and "
                f"single hyphens, beginning with a letter, without 'oodd-', at most {LONGEST} "
                f"characters{hint}"
            )

    @property
    def distribution(self) -> str:
        """What pip installs."""
        return f"oodd-{self.name}"

    @property
    def module(self) -> str:
        """What Python imports."""
        return self.distribution.replace("-", "_")

    @property
    def class_name(self) -> str:
        """Of the detector."""
        return "".join(part.capitalize() for part in self.name.split("-"))

    def render(self) -> dict[str, str]:
        """Return the contents of all files by their paths in the project."""
        templates = files(__name__) / "templates"
        return {
            self._fill(path): self._fill((templates / template).read_text(encoding="utf-8"))
            for path, template in FILES.items()
        }

    def _fill(self, text: str) -> str:
        names = {
            "@NAME@": self.name,
            "@DISTRIBUTION@": self.distribution,
            "@MODULE@": self.module,
            "@CLASS@": self.class_name,
        }
        return re.sub("@[A-Z]+@", lambda found: names[found[0]], text)


def write_project(project: Project, directory: Path) -> list[Path]:
    """Write all files of a project.

    Parameters
    ----------
    project
        Its names.
    directory
        Where to; it must not exist, or be empty.

    Returns
    -------
    list of Path
        The files, beginning with `directory`.

    Raises
    ------
    OutputError
        When something is there already, or nothing can be written there.
    """
    written = []
    try:
        if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
            raise OutputError(
                f"{str(directory)!r} exists and is not an empty directory: name another with "
                "--output"
            )
        for path, text in project.render().items():
            file = directory / path
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text, encoding="utf-8")
            written.append(file)
    except OSError as error:
        if isinstance(error, OutputError):
            raise
        raise OutputError(
            f"{str(directory)!r} cannot be written: {error.strerror}; name another place with "
            "--output"
        ) from None
    return written


def _is_name(text: str) -> bool:
    return (
        re.fullmatch("[a-z][a-z0-9]*(-[a-z0-9]+)*", text) is not None
        and len(text) <= LONGEST
        and not text.startswith("oodd-")
        and text not in RESERVED
    )


def _tidy(text: str) -> str:
    """Return what a text would be as a name; not every text can be one."""
    words = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "-", text)
    tidy = re.sub("[^a-z0-9]+", "-", words.lower()).strip("-").removeprefix("oodd-")
    return tidy[:LONGEST].strip("-").lstrip("0123456789-")
