"""A ready plug-in project: the files that ``oodd-eval new`` writes.

Templates lie beside this module, each ending in ``.in`` so that nothing takes them for source of
this package. ``@NAME@`` and the like stand for the names of the project, in paths and in contents.
"""

import re
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Final

from oodd_eval._version import repository
from oodd_eval.errors import OutputError, UsageError

_SHARED: Final = {".gitignore": "gitignore.in", "src/@MODULE@/py.typed": "py.typed.in"}

FILES: Final = {
    "pyproject.toml": "pyproject.toml.in",
    "README.md": "readme.md.in",
    ".github/workflows/ci.yml": "ci.yml.in",
    "src/@MODULE@/__init__.py": "plugin.py.in",
    "src/@MODULE@/detector.py": "detector.py.in",
    "tests/test_detector.py": "test.py.in",
    **_SHARED,
}
"""Path in the project and template, in the order in which they are told."""

ENVIRONMENT_FILES: Final = {
    "pyproject.toml": "environment/pyproject.toml.in",
    "README.md": "environment/readme.md.in",
    ".github/workflows/ci.yml": "environment/ci.yml.in",
    "src/@MODULE@/__init__.py": "environment/plugin.py.in",
    "src/@MODULE@/simulation.py": "environment/simulation.py.in",
    "src/@MODULE@/policy.py": "environment/policy.py.in",
    "src/@MODULE@/anomalies.py": "environment/anomalies.py.in",
    "tests/test_environment.py": "environment/test.py.in",
    **_SHARED,
}
"""The same of a project with an environment."""

LONGEST: Final = 30  # so that lines of the templates stay within their limit
_RESERVED: Final = ("all", "eval")  # every detector, and this distribution


_WHEEL: Final = "wheels/oodd_eval-*.whl"  # where oodd-eval is installed from without an address

_CONDITION: Final = f"""\
        # oodd-eval is on no package index yet: this step waits for its wheel in wheels/.
        if: hashFiles('{_WHEEL}') != ''
"""

_ADVICE: Final = """
Until a package index has oodd-eval, put its wheel into `wheels/`, from where the first command and
the CI workflow install it. Where oodd-eval is installed already, leave the first command out.
"""


@dataclass(frozen=True, slots=True)
class Project:
    """The names of a plug-in project, which follow from that of its detector or environment."""

    name: str
    environment: bool = False

    def __post_init__(self) -> None:
        if self.name in _RESERVED:
            raise UsageError(f"{self.name!r} means something else: choose another name")
        if not _is_name(self.name):
            close = _tidy(self.name)
            hint = f"; did you mean {close!r}?" if _is_name(close) else ""
            raise UsageError(
                f"{self.name!r} is no name for a project: expected lower-case letters, digits and "
                f"single hyphens, beginning with a letter, without 'oodd-', at most {LONGEST} "
                f"characters{hint}"
            )

    @property
    def distribution(self) -> str:
        """Name for pip."""
        return f"oodd-{self.name}"

    @property
    def module(self) -> str:
        """Name for Python's import."""
        return self.distribution.replace("-", "_")

    @property
    def wheel(self) -> str:
        """Name of the file that pip makes of its first version."""
        return f"{self.module}-0.1.0-py3-none-any.whl"

    @property
    def class_name(self) -> str:
        """Name of the detector's class, without "Detector"."""
        return "".join(part.capitalize() for part in self.name.split("-"))

    def render(self) -> dict[str, str]:
        """Return the contents of all files by their paths in the project."""
        address = repository()
        names = {
            "@NAME@": self.name,
            "@DISTRIBUTION@": self.distribution,
            "@MODULE@": self.module,
            "@WHEEL@": self.wheel,
            "@CLASS@": self.class_name,
            "@PROJECT@": "oodd-eval",
            "@SOURCE@": _WHEEL,
            "@CONDITION@": _CONDITION,
            "@ADVICE@": _ADVICE,
        }
        if address:
            names |= {"@PROJECT@": f"[oodd-eval]({address})", "@CONDITION@": "", "@ADVICE@": ""}
            names["@SOURCE@"] = f'"oodd-eval @ git+{address}"'
        templates = files(__name__) / "templates"

        def fill(text: str) -> str:
            return re.sub("@[A-Z]+@", lambda match: names[match[0]], text)

        return {
            fill(path): fill((templates / template).read_text(encoding="utf-8"))
            for path, template in (ENVIRONMENT_FILES if self.environment else FILES).items()
        }


def write_project(project: Project, directory: Path) -> list[Path]:
    """Write all files of a project into a new or empty directory, and return their paths."""
    rendered = {directory / path: text for path, text in project.render().items()}
    advice = "name another with --output"
    try:
        if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
            raise OutputError(f"{str(directory)!r} exists and is not an empty directory: {advice}")
        for file, text in rendered.items():
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text, encoding="utf-8")
    except OSError as error:
        if isinstance(error, OutputError):
            raise
        reason = f"{str(directory)!r} cannot be written: {error.strerror}; {advice}"
        raise OutputError(reason) from None
    return list(rendered)


def _is_name(text: str) -> bool:
    plain = re.fullmatch("(?!oodd-)[a-z][a-z0-9]*(-[a-z0-9]+)*", text)
    return bool(plain) and len(text) <= LONGEST and text not in _RESERVED


def _tidy(text: str) -> str:
    """Return a text as a name; not every text can be one."""
    words = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "-", text)
    tidy = re.sub("[^a-z0-9]+", "-", words.lower()).strip("-").removeprefix("oodd-")
    return tidy[:LONGEST].strip("-").lstrip("0123456789-")
