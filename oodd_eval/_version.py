"""The distribution's version, which the build reads, and the address of its repository."""

__version__ = "0.3.0"


def repository() -> str:
    """Return the address of oodd-eval's repository, empty while ``pyproject.toml`` has none."""
    from importlib.metadata import metadata  # noqa: PLC0415 - every import of the package pays

    urls = metadata("oodd-eval").get_all("Project-URL") or []
    named = dict(str(url).split(", ", 1) for url in urls)
    return named.get("Repository", "")
