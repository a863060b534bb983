"""Debian's packages, downloaded as a user and read where they lie: nothing is installed."""

from __future__ import annotations

import lzma
import re
import shutil
import subprocess
import tarfile
from pathlib import Path

_DOWNLOAD = 300.0  # s
_FLAVOUR = r"\.[0-9]+[-+][0-9a-z]+-amd64"  # the full kernel: the cloud flavour has neither uinput nor CAN


class Missing(RuntimeError):
    """Something that is needed is not here; the text names it, and what brings it."""


def newest_kernel(series: str) -> str:
    """Name of the newest kernel package of a series such as ``6.12``. Raises Missing."""
    pattern = rf"^linux-image-{re.escape(series)}{_FLAVOUR}$"
    try:
        listed = _output(["apt-cache", "search", "--names-only", pattern])
    except FileNotFoundError:
        raise Missing("apt-cache is not here: the kernels come from Debian's packages (amd64)") from None
    names = [line.split(" ", 1)[0] for line in listed.splitlines()]
    if not names:
        raise Missing(
            f"apt knows no package linux-image-{series}.*-amd64; run: sudo apt-get update, on a Debian that has it "
            "(6.1 and 6.12: Debian 12)"
        )
    return max(names, key=lambda name: [int(number) for number in re.findall(r"\d+", name)])


class Package:
    """One package: its files can be read."""

    def __init__(self, name: str, folder: Path) -> None:
        """Downloads it into ``folder``, which is to be removed afterwards. Raises Missing."""
        try:
            _output(["apt-get", "download", "-q", name], folder)
        except FileNotFoundError:
            raise Missing(f"apt-get is not here; the package {name} is needed") from None
        except subprocess.CalledProcessError as error:
            said = error.stderr.strip().splitlines() or ["nothing said"]
            raise Missing(f"could not download {name} ({said[-1]}); run: sudo apt-get update") from None
        (archive,) = folder.glob(f"{name}_*.deb")
        unpacked = folder / f"{name}.tar"
        with open(unpacked, "wb") as out:
            subprocess.run(["dpkg-deb", "--fsys-tarfile", archive], stdout=out, check=True, timeout=_DOWNLOAD)
        archive.unlink()
        self.name = name
        self._tar = tarfile.open(unpacked)  # noqa: SIM115  (closed with the folder that it lies in)
        self.files = {member.name.removeprefix("./"): member for member in self._tar if member.isfile()}

    def read(self, path: str) -> bytes:
        """A file's contents, unpacked if its name ends in ``.xz``."""
        stream = self._tar.extractfile(self.files[path])
        data = stream.read()
        return lzma.decompress(data) if path.endswith(".xz") else data

    def find(self, pattern: str) -> str:
        """The one path that matches. Raises Missing."""
        found = [path for path in self.files if re.fullmatch(pattern, path)]
        if len(found) != 1:
            raise Missing(f"the package {self.name} has {len(found)} files like {pattern}")
        return found[0]


def _output(command: list[str], folder: Path | None = None) -> str:
    if shutil.which(command[0]) is None:
        raise FileNotFoundError(command[0])
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True, timeout=_DOWNLOAD)
    return done.stdout
