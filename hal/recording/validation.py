"""Validate what is read from a dataset: names, columns, and one kind of error for every missing or damaged file."""

from __future__ import annotations

import contextlib
import errno
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from ..errors import DatasetError, HalError
from .layout import DatasetLayout

_SIDE = 16384
"""Pixels; no picture is larger."""
_DISK_REFUSES = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS}


def checked_name(name: str) -> str:
    """Return ``name``, a part of a file name. Raises ValueError for one that would lead to another folder."""
    if not name or "/" in name or "\0" in name or name in (".", ".."):
        raise ValueError("must be a name without slashes")
    return name


CameraName = Annotated[str, AfterValidator(checked_name)]


class Model(BaseModel):
    """A record of which the keys that are used here are validated."""

    model_config = ConfigDict(strict=True, extra="ignore")


class Feature(Model):
    """A column or a video in ``features`` of ``meta/info.json``."""

    dtype: str
    shape: list[Annotated[int, Field(ge=1, le=_SIDE)]]
    names: list[str] | None = None

    @model_validator(mode="after")
    def _has_a_name_per_number(self) -> Feature:
        if self.dtype != "video" and self.names is not None and [len(self.names)] != self.shape:
            raise ValueError(f"{len(self.names)} names for the shape {self.shape}")
        return self


@contextlib.contextmanager
def dataset_errors(layout: DatasetLayout, path: Path, episode: int | None = None) -> Iterator[None]:
    """Raise any error of a missing or damaged file as a DatasetError that names the file and the episode.

    A disk that refuses what is written meanwhile is no damage: its OSError is raised as it is.
    """
    try:
        yield
    except HalError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno in _DISK_REFUSES:
            raise
        raise wrong_file(layout, path, _reason(error), episode) from error


def wrong_file(
    layout: DatasetLayout, path: Path, what: str, episode: int | None = None, code: str | None = None
) -> DatasetError:
    """Return the error of a file, which it names relative to the dataset's folder."""
    file = str(path.relative_to(layout.root)) if path.is_relative_to(layout.root) else str(path)
    return DatasetError(what, file=file, episode=episode, code=code)


def _reason(error: Exception) -> str:
    if isinstance(error, FileNotFoundError):
        return "is missing"
    if isinstance(error, ValidationError):
        first = error.errors(include_url=False, include_input=False)[0]
        return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    text = (str(error).splitlines() or [""])[0][:200]
    return f"cannot be read: {text or type(error).__name__}"
