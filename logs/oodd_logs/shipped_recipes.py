"""Recipes of public logs that come with the package: a wheel has them inside, a checkout beside."""

from pathlib import Path
from types import MappingProxyType
from typing import Final

FOLDERS: Final = (Path(__file__).parent / "recipes", Path(__file__).parents[2] / "recipes")
"""Folder in an installed wheel, and in a checkout."""


def shipped_recipes() -> MappingProxyType[str, Path]:
    """Return the files of the recipes that come with the package, by name.

    Returns
    -------
    Mapping
        Name of the recipe, such as ``"skab"``, to its TOML file.

    >>> "skab" in shipped_recipes()
    True
    """
    folder = next((folder for folder in FOLDERS if folder.is_dir()), None)
    files = sorted(folder.glob("*.toml")) if folder else []
    return MappingProxyType({file.stem: file for file in files})
