"""Where Ark would find a file: mostly relative to the folder that it is started in, which its files do not say."""

from __future__ import annotations

from pathlib import Path

from ..kinematics.urdf import package_folder

__all__ = ["Places", "PackageFile"]

UPWARDS = 4
"""So many folders above the global file are looked in: the tutorial's robots lie three above its own folder."""
PACKAGE = "pybullet_data"
"""The package whose folder Ark tells PyBullet to look in as well."""


class PackageFile(str):
    """Path of a file inside :data:`PACKAGE`."""


class Places:
    """Looks for files. ``global_file`` is Ark's; ``start`` the folder that Ark is started in, if that is known."""

    def __init__(self, global_file: Path, start: Path | None) -> None:
        folder = global_file.parent
        guesses = [start] if start is not None else [folder, *folder.parents[:UPWARDS], Path.cwd()]
        self.starts = list(dict.fromkeys(guess.resolve() for guess in guesses))

    def find(self, path: str, *beside: Path) -> Path | None:
        """A file or folder: ``path`` from where Ark starts, or from one of the folders ``beside``."""
        given = Path(path).expanduser()
        return next(
            (there for folder in (*self.starts, *beside) if (there := (folder / given).resolve()).exists()), None
        )

    def in_package(self, path: str) -> PackageFile | None:
        """The same in PyBullet's own data, where Ark looks for the URDFs of objects."""
        folder = package_folder(PACKAGE)
        return PackageFile(path) if folder is not None and (folder / path).is_file() else None

    def told(self) -> str:
        """Where it was looked, in words."""
        first, *others = map(str, self.starts)
        return first if not others else f"{first} and {len(others)} more folders"
