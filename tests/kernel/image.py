"""What the virtual machine boots: a Debian kernel, and the few of its modules that the checks need."""

from __future__ import annotations

import gzip
import hashlib
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

from packages import Missing, Package, newest_kernel

_MODULES = (
    *("virtio_pci", "9pnet_virtio", "9p"),  # the host's files
    *("evdev", "uinput", "uhid", "hid-generic", "hid-sony", "hid-playstation"),
    *("vhci-hcd", "xpad"),
    *("vcan", "can-raw"),
    "vivid",
)
_OPTIONS = {"vivid": "n_devs=2 node_types=0x1,0x1 num_inputs=1,1 input_types=0,0"}
"""Options with which a module is loaded: two cameras."""
TEXT, PROGRAM = 0o100644, 0o100755  # modes of files


class Image(NamedTuple):
    """What qemu is given."""

    name: str
    """The kernel's package."""
    kernel: Path
    initrd: Path
    """An archive of ``busybox``, the modules, and ``modules``: a line for each, in the order in which they load, with
    its name and its options."""


def image_for(series: str, refresh: bool, say: Callable[[str], None]) -> Image:
    """The image of a series such as ``6.12``: from the cache, or made of packages that are downloaded.

    With ``refresh`` the newest package is downloaded though there is an image in the cache. Raises Missing.
    """
    recipe = hashlib.sha256(f"{_MODULES} {_OPTIONS}".encode()).hexdigest()[:8]
    known = list(_cache().glob(f"linux-image-{series}.*"))
    for folder in known:
        if folder.name.endswith(f".{recipe}") and not refresh:
            return _image(folder)
    name = newest_kernel(series)
    say(f"downloading {name} (once, about 100 MB, of which {_cache()} keeps 15) and busybox-static")
    _cache().mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=_cache()) as scratch:
        made = _make(name, Path(scratch))
        for folder in known:
            shutil.rmtree(folder)
        return _image(made.rename(_cache() / f"{name}.{recipe}"))


def _image(folder: Path) -> Image:
    return Image(folder.stem, folder / "vmlinuz", folder / "initrd")


def _cache() -> Path:
    root = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(root) / "robot-hal" / "kernel"


def _make(name: str, scratch: Path) -> Path:
    """A folder with the image of that kernel."""
    package, busybox = Package(name, scratch), Package("busybox-static", scratch)
    modules = _with_what_they_need(_MODULES, package)
    files = [
        ("busybox", PROGRAM, busybox.read(busybox.find(r"(usr/)?bin/busybox"))),
        ("modules", TEXT, "".join(f"{module} {_OPTIONS.get(module, '')}\n" for module in modules).encode()),
        *((f"{module}.ko", TEXT, data) for module, data in modules.items()),
    ]
    made = scratch / "image"
    made.mkdir()
    (made / "vmlinuz").write_bytes(package.read(package.find(r"boot/vmlinuz-.*")))
    (made / "initrd").write_bytes(gzip.compress(archive(files)))
    return made


def _with_what_they_need(wanted: Iterable[str], package: Package) -> dict[str, bytes]:
    """Module -> its file, in the order in which they load. Those that are built into the kernel are left out."""
    paths = {}
    for path in package.files:
        match = re.fullmatch(r".*/([^/]+)\.ko(\.xz)?", path)
        if match:
            paths[_plain(match[1])] = path
    builtin = package.read(package.find(r".*/modules\.builtin")).decode()
    inside = {_plain(Path(line).stem) for line in builtin.splitlines()}
    found: dict[str, bytes] = {}

    def load(module: str) -> None:
        if module in found or module in inside:
            return
        if module not in paths:
            raise Missing(f"the package {package.name} has no module {module}")
        data = package.read(paths[module])
        for names in re.findall(rb"\0depends=([^\0]*)", data):  # of its section .modinfo
            for name in filter(None, names.decode().split(",")):
                load(_plain(name))
        found[module] = data

    for module in wanted:
        load(_plain(module))
    return found


def _plain(module: str) -> str:
    """Both spellings of a module's name mean the same."""
    return module.replace("-", "_")


def archive(files: Iterable[tuple[str, int, bytes]]) -> bytes:
    """Files (name, mode, contents) of one folder, as the kernel unpacks them when it starts: cpio's "newc" format.

    Format: the kernel's ``Documentation/driver-api/early-userspace/buffer-format.rst``.
    """
    out = bytearray()
    for number, (name, mode, data) in enumerate((*files, ("TRAILER!!!", 0, b"")), start=1):
        path = name.encode() + b"\0"
        fields = (number, mode, 0, 0, 1, 0, len(data), 0, 0, 0, 0, len(path), 0)
        out += b"070701" + b"".join(b"%08x" % field for field in fields) + path
        out += bytes(-len(out) % 4) + data
        out += bytes(-len(out) % 4)
    return bytes(out)
