"""Where the answer goes: over the rig's own file, with a copy of what it was, or into another one."""

from __future__ import annotations

from pathlib import Path

from ..config import load
from ..config.data_files import data_folder
from ..errors import CommandError
from .writing import backup, replaced, write

__all__ = ["Output"]


class Output:
    """A rig's file whose camera gets a new place. Whatever is wrong with it is told before anything moves."""

    @classmethod
    def of(cls, source: str, out: str | None, camera: str) -> Output | None:
        """For the rig in the file ``source``: that file, or ``out``. None for a file that comes with the hal, which is
        changed by nobody, where there is no ``out``. Raises CommandError, OSError."""
        if out is None and Path(source).resolve().is_relative_to(data_folder("config").resolve()):
            return None
        return cls(Path(source), Path(source if out is None else out).expanduser(), camera)

    def __init__(self, source: Path, path: Path, camera: str) -> None:
        self.source, self.path, self.camera = source, path, camera
        if not self.path.resolve().parent.is_dir():
            raise CommandError(f"there is no folder {self.path.resolve().parent}")
        self._changed("pose", "[0, 0, 0, 0, 0, 0, 1]")

    def _changed(self, key: str, value: str) -> str:
        return replaced(self.source.read_bytes().decode("utf-8"), self.camera, key, value)

    def write(self, key: str, value: str) -> list[str]:
        """Write it; returns what was done, in words. The file is read anew: it may have been edited meanwhile.

        Raises CommandError and OSError, and ConfigError where the new file would be no rig; nothing is changed then.
        """
        text = self._changed(key, value)
        trial = self.path.resolve().with_name(f".{self.path.name}.trial.yaml")
        try:
            write(trial, text)
            load(trial)
        finally:
            trial.unlink(missing_ok=True)
        told = []
        if self.path.exists():
            told.append(f"what it was: {backup(self.path)}")
        write(self.path, text)
        return [*told, f"written: {self.path}"]
