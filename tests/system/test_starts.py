"""A rig opens, moves and closes wherever Python runs, and leaves no process behind."""

import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

import hal

pytestmark = pytest.mark.slow

BODY = """
import hal
rig = hal.open("panda_table", sim=True, pad="none")
arm = rig.robots["panda"]
goal = arm.home.copy()
goal[0] += 0.05
arm.move_to(goal, speed=0.5)
frame = rig.cameras["scene"].read(timeout=20.0)
print("moved", round(float(arm.state().q[0]), 3), "saw", frame.color.shape)
print("children", *[h.child.process.pid for h in rig._hosts], rig._pictures._child.process.pid)
"""
WITH = BODY + "rig.close()\n"


def expect(output: str) -> None:
    """It moved, it saw, and its processes are gone."""
    assert "moved 0.05 saw (256, 256, 3)" in output, output
    pids = [int(pid) for pid in re.search(r"children (\d+) (\d+)", output).groups()]
    deadline = time.monotonic() + 30.0
    while any(os.path.exists(f"/proc/{pid}") for pid in pids):
        assert time.monotonic() < deadline, f"still there: {pids}"
        time.sleep(0.02)


def run(arguments: list[str], program: str | None, folder: Path) -> str:
    done = subprocess.run(
        [sys.executable, *arguments], input=program, cwd=folder, capture_output=True, text=True, timeout=90
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("how", ["unguarded script", "standard input", "thread"])
def test_a_program(tmp_path: Path, how: str) -> None:
    """Without a main guard, and where nothing closes the rig."""
    body = "\n    ".join(WITH.strip().splitlines())
    threaded = f"import threading\ndef run():\n    {body}\nt = threading.Thread(target=run)\nt.start()\nt.join()\n"
    script = tmp_path / "experiment.py"
    script.write_text(WITH)
    arguments, program = {
        "unguarded script": ([str(script)], None),
        "standard input": (["-"], BODY),
        "thread": (["-c", threaded], None),
    }[how]
    expect(run(arguments, program, tmp_path))


def test_a_notebook_kernel(tmp_path: Path) -> None:
    try:
        from jupyter_client.manager import start_new_kernel
    except ImportError:
        pytest.skip("ipykernel is not installed")
    manager, client = start_new_kernel(kernel_name="python3", cwd=str(tmp_path), startup_timeout=60)
    printed: list[str] = []

    def collect(message: dict) -> None:
        if message["msg_type"] == "stream":
            printed.append(message["content"]["text"])

    try:
        reply = client.execute_interactive(BODY, timeout=90, output_hook=collect)
        assert reply["content"]["status"] == "ok", reply["content"]
    finally:
        client.stop_channels()
        manager.shutdown_kernel()
    expect("".join(printed))


def test_two_rigs_at_once_and_one_after_the_other(tmp_path: Path) -> None:
    program = """
import hal
for _ in range(2):
    with hal.open("panda_table", driver="mock") as a, hal.open("franka", driver="mock", pad="none") as b:
        a.clock.sleep(0.1); b.clock.sleep(0.2)
        print(a.clock.now() < b.clock.now(), a.robots["panda"].n)
"""
    assert run(["-c", program], None, tmp_path).split() == ["True", "7"] * 2


@pytest.mark.parametrize("change", ["none", "path", "upgrade"])
def test_the_servo_runs_the_copy_of_the_library_that_the_app_runs(tmp_path: Path, change: str) -> None:
    """Another copy than the installed one, by PYTHONPATH; a servo that cannot run the same code is refused."""
    installed = Path(hal.__file__).parent
    copy = shutil.copytree(installed, tmp_path / "hal", ignore=shutil.ignore_patterns("__pycache__"))
    other_layout = f"with open({str(copy / 'host' / 'records.py')!r}, 'a') as file: file.write('LAYOUT += 1\\n')\n"
    if change == "none":
        exec(other_layout)  # the installed copy would be refused
    program = "import hal, sys, hal.host.records\n"
    program += {"none": "", "path": f"sys.path.remove({str(tmp_path)!r})\n", "upgrade": other_layout}[change]
    program += "try:\n    rig = hal.open('panda_table', sim=True, pad='none', overrides=['cameras={}'])\n"
    program += "except hal.NotSupported as error: print(error.code, error)\nelse: rig.close(); print('opened')\n"
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=tmp_path.parent,
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    told = {"none": "opened", "path": "version_mismatch", "upgrade": "version_mismatch"}[change]
    assert done.stdout.startswith(told), done.stdout + done.stderr
    if change != "none":
        assert str(copy) in done.stdout


LAB_ARM = """
import os
from hal.drivers.mock.robot import MockRobot

WHERE, END = {where!r}, {end!r}

def end(where):
    if where == WHERE:
        print("the last line of the lab's driver")
        exec(END)

class Arm(MockRobot):
    def open(self):
        super().open()
        end("open")

end("import")
"""
LAB_DRIVER = """
from hal.registry import DriverSpec
DRIVER = DriverSpec(name="lab", robot="lab_arm:Arm")
"""


@pytest.mark.parametrize(
    ("where", "end", "says"),
    [
        ("import", "os.kill(os.getpid(), 2)", "SIGINT"),
        ("open", "os.kill(os.getpid(), 9)", "SIGKILL"),
        ("open", "os._exit(3)", "status 3"),
    ],
)
def test_a_host_that_ends_while_it_starts_has_a_cause(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str, end: str, says: str
) -> None:
    (tmp_path / "lab_arm.py").write_text(LAB_ARM.format(where=where, end=end))
    (tmp_path / "lab_driver.py").write_text(LAB_DRIVER)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "lab_driver", raising=False)
    arm = {"model": "panda", "drivers": {"real": "lab_driver:DRIVER"}, "gripper": {"enabled": False}}
    with pytest.raises(hal.ConnectionLost, match=rf"process ended while it started \({says}") as caught:
        hal.open({"sim": False, "robots": {"arm": arm}}).close()
    assert caught.value.code == "process_ended"
    assert "the last line of the lab's driver" in str(caught.value)
