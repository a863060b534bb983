"""What a person may say about an import besides the files themselves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

__all__ = ["Options"]


@dataclass(frozen=True)
class Options:
    """Names are those in Ark's files."""

    start: Path | None = None
    """The folder that Ark is started in, which its paths are relative to; None: it is searched for."""
    arms: Mapping[str, str] = field(default_factory=dict)
    """Robot -> model of the hal that it is, where its joints do not say it."""
    urdfs: Mapping[str, Path] = field(default_factory=dict)
    """Robot or object -> its URDF, where it is not where the file says."""
    without: frozenset[str] = frozenset()
    """Robots, sensors and objects to leave out."""
    camera_model: str = "pinhole"
    """Of every camera: ``pinhole`` has the angles of Ark's file; a real one's name gives its own, simulated or not."""
