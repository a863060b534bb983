"""A virtual machine that runs one command among the host's files and ends."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
import threading
from collections.abc import Generator
from pathlib import Path

from image import PROGRAM, TEXT, Image, archive

from packages import Missing

_INIT = Path(__file__).with_name("init")
_QEMU = "qemu-system-x86_64"
_KERNEL_ARGUMENTS = "console=ttyS0 quiet panic=-1 mitigations=off tsc=reliable no_timer_check random.trust_cpu=on"


class Machine:
    """One start of an image. Its processor is emulated, so it needs no rights, and no support by the host's own.

    The host's files are there, read-only, under their own paths. ``/run`` is empty and can be written to.
    """

    def __init__(self, image: Image, job: str, limit: float) -> None:
        """``job``: a shell script. After ``limit`` s the machine is ended, whatever it does."""
        self.image = image
        self.console = ""
        """What the kernel and the job printed, once the machine has ended."""
        self._job = job
        self._limit = limit

    def lines(self) -> Generator[str, None, None]:
        """Runs; yields what the job writes to ``/dev/ttyS1``. Raises Missing. Left early, it ends the machine."""
        if shutil.which(_QEMU) is None:
            raise Missing(f"{_QEMU} is not here; run: sudo apt-get install qemu-system-x86")
        with tempfile.TemporaryDirectory() as scratch:
            console, initrd = Path(scratch, "console"), Path(scratch, "initrd")
            limit = str(round(self._limit)).encode()  # the machine's own, should nobody be left to end it
            files = [("init", PROGRAM, _INIT.read_bytes()), ("job", TEXT, self._job.encode()), ("limit", TEXT, limit)]
            initrd.write_bytes(archive(files) + self.image.initrd.read_bytes())
            qemu = subprocess.Popen(
                self._command(initrd, console),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
                start_new_session=True,  # Ctrl-C in the terminal reaches only us, and we end it
            )
            watch = threading.Timer(self._limit, qemu.kill)
            watch.daemon = True
            watch.start()
            try:
                assert qemu.stdout is not None
                for line in qemu.stdout:
                    yield line.rstrip()
            finally:
                watch.cancel()
                qemu.kill()
                qemu.wait()
                if console.exists():
                    self.console = console.read_text(errors="replace")

    def _command(self, initrd: Path, console: Path) -> list[str]:
        return [
            _QEMU,
            *("-accel", "tcg,thread=multi", "-cpu", "max", "-machine", "q35", "-smp", "2", "-m", "768"),
            *("-nodefaults", "-no-reboot", "-display", "none", "-device", "virtio-rng-pci"),
            *("-serial", f"file:{console}", "-serial", "stdio"),
            *("-fsdev", "local,id=host,path=/,security_model=none,readonly=on,multidevs=remap"),
            *("-device", "virtio-9p-pci,fsdev=host,mount_tag=host"),
            *("-kernel", str(self.image.kernel), "-initrd", str(initrd), "-append", _KERNEL_ARGUMENTS),
        ]
