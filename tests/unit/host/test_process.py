"""Child processes: start from anywhere, answer, pass errors on, end without leaving anything."""

import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from hal.errors import ConfigError, ConnectionLost, MotionStopped, NotSupported, Problem
from hal.host.process import Channel, Child, SharedMemory, pack_error, unpack_error

HERE = Path(__file__).parents[2] / "kits"


@pytest.fixture(autouse=True)
def targets_on_path(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(HERE))
    return


def start(**config: object) -> Child:
    child = Child("echo", "child_targets:echo", config)
    child.wait_ready(20.0)
    return child


def test_answers_and_memory() -> None:
    memory = SharedMemory(64)
    child = Child("echo", "child_targets:echo", {"x": "ä" * 100_000}, [memory])
    ready = child.wait_ready(20.0)
    assert ready["path"] == "ä" * 100_000
    assert bytes(memory.buffer[:5]) == b"hello"
    assert child.request("say", {"a": [1, 2.5]}) == {"a": [1, 2.5]}
    child.close()
    child.close()
    assert child.process.returncode == 0
    with pytest.raises(ConnectionLost) as caught:
        child.request("say")
    assert caught.value.code == "process_ended"


def test_an_error_while_it_starts_is_the_same_error_here() -> None:
    child = Child("echo", "child_targets:echo", {"start": "fail"})
    with pytest.raises(ConfigError) as caught:
        child.wait_ready(20.0)
    assert caught.value.problems[0].key == "robots.panda"
    child.close()


def test_an_error_in_a_request_is_raised_here_and_the_child_continues() -> None:
    child = start()
    with pytest.raises(ConnectionLost) as caught:
        child.request("fail")
    assert caught.value.code == "arm_gone"
    with pytest.raises(NotSupported) as unknown:
        child.request("unheard_of")
    assert unknown.value.code == "no_such_request"
    assert child.request("say", {"b": 1}) == {"b": 1}
    child.close()


def test_the_error_for_a_child_that_ended_has_its_last_output() -> None:
    child = start()
    with pytest.raises(ConnectionLost, match=r"these are my last words") as caught:
        child.request("die")
    assert caught.value.code == "process_ended"
    child.close()


def test_a_child_that_never_gets_ready_is_ended() -> None:
    child = Child("echo", "child_targets:echo", {"start": "never"})
    with pytest.raises(ConnectionLost) as caught:
        child.wait_ready(0.3)
    assert caught.value.code == "process_silent"
    child.close(timeout=0.2)
    assert child.process.returncode is not None


def test_requests_from_many_threads_get_their_own_answers() -> None:
    child = start()
    wrong: list[object] = []

    def ask(who: int) -> None:
        for k in range(50):
            if child.request("say", {"who": who, "k": k}) != {"who": who, "k": k}:
                wrong.append((who, k))

    threads = [threading.Thread(target=ask, args=(who,)) for who in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    child.close()
    assert wrong == []


def test_a_request_before_the_child_is_ready_gets_its_answer() -> None:
    child = Child("echo", "child_targets:echo", {})
    assert child.request("say", {"a": 1}) == {"a": 1}
    assert child.wait_ready(20.0)["pid"] == child.process.pid
    child.close()


def test_an_answer_that_takes_too_long_is_dropped() -> None:
    child = start()
    with pytest.raises(ConnectionLost) as caught:
        child.request("sleep", {"seconds": 0.3}, timeout=0.05)
    assert caught.value.code == "process_silent"
    assert not child.busy
    assert child.request("say", {"a": 1}) == {"a": 1}
    child.close()


def test_messages_that_are_no_answers_are_passed_on() -> None:
    heard: list[int] = []
    child = Child("echo", "child_targets:echo", {}, on_message=lambda message: heard.append(message["news"]))
    child.wait_ready(20.0)
    assert child.request("news", {"count": 3}) is None
    assert heard == [0, 1, 2]
    child.notify("news", {"count": 2})
    assert child.listen(5.0)
    assert child.listen(5.0)
    assert not child.listen(0.0)
    assert heard == [0, 1, 2, 0, 1]
    child.close()
    with pytest.raises(ConnectionLost):
        child.listen(0.0)


def test_an_error_in_a_message_without_answer_ends_the_child() -> None:
    child = start()
    child.notify("fail")
    with pytest.raises(ConnectionLost) as caught:
        child.request("say")
    assert caught.value.code == "arm_gone"
    child.close()


def test_a_busy_receiver_loses_only_messages_that_may_be_lost() -> None:
    ours, theirs = socket.socketpair()
    ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
    sender, receiver = Channel(ours), Channel(theirs)
    sent = sum(sender.send_if_free({"frame": k}) for k in range(5000))
    assert 0 < sent < 5000
    assert [receiver.receive(1.0)["frame"] for _ in range(sent)] == list(range(sent))
    assert receiver.poll() is None
    for message in (None, {"frame": 0}):
        assert sender.send_if_free(message)
    assert receiver.poll_all() == [None, {"frame": 0}]
    receiver.close()
    with pytest.raises(ConnectionLost):
        sender.send_if_free({"frame": 0})
    sender.close()


PROGRAM = """
import sys
sys.path.insert(0, {here!r})
from hal.host.process import Child
child = Child("echo", "child_targets:echo", {{}})
child.wait_ready(20.0)
assert child.request("say", {{"a": 1}}) == {{"a": 1}}
print("fine")
child.close()
"""


@pytest.mark.parametrize("how", ["script", "stdin", "-c", "thread"])
def test_starts_from_anywhere_also_beside_files_that_shadow_the_library(tmp_path: Path, how: str) -> None:
    """No main guard, and a folder with its own json.py: what breaks multiprocessing and ``python -m``."""
    (tmp_path / "json.py").write_text("raise RuntimeError('the wrong json')")
    (tmp_path / "drivers").mkdir()
    (tmp_path / "drivers" / "__init__.py").write_text("raise RuntimeError('the wrong drivers')")
    program = PROGRAM.format(here=str(HERE))
    if how == "thread":
        body = "\n    ".join(program.strip().splitlines())
        program = f"import threading\ndef run():\n    {body}\nt = threading.Thread(target=run)\nt.start()\nt.join()\n"
    (tmp_path / "program").mkdir()
    script = tmp_path / "program" / "unguarded.py"
    script.write_text(program)
    arguments = {"stdin": ["-"], "-c": ["-c", program]}.get(how, [str(script)])
    # A shadowed json breaks `python -` and `-c` themselves (the folder is on their path), so only children see it.
    folder = tmp_path if how in ("script", "thread") else tmp_path / "program"
    done = subprocess.run(
        [sys.executable, *arguments],
        input=program if how == "stdin" else None,
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.stdout.strip() == "fine", done.stderr


def test_memory_is_freed_by_the_process_that_created_it_and_by_no_other() -> None:
    memory = SharedMemory(1 << 20)
    other = SharedMemory(fd=os.dup(memory.fd))
    memory.buffer[:] = b"1" * memory.size
    other.close()
    if (pid := os.fork()) == 0:
        memory.close()
        os._exit(0)
    os.waitpid(pid, 0)
    assert bytes(memory.buffer[:2]) == b"11"
    memory.close()
    assert bytes(memory.buffer[:2]) == bytes(2), "its pages are given back, though views of it are left"


def test_ends_when_its_parent_is_killed(tmp_path: Path) -> None:
    """Nothing is left, though nobody could clean up."""
    program = PROGRAM.format(here=str(HERE)).replace("child.close()", "print(child.process.pid, flush=True); input()")
    parent = subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=tmp_path
    )
    assert parent.stdout.readline().strip() == "fine"
    pid = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    deadline = time.monotonic() + 10.0
    while os.path.exists(f"/proc/{pid}") and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not os.path.exists(f"/proc/{pid}")


def test_an_error_keeps_its_type_code_and_problems_across_a_process_boundary() -> None:
    stopped = unpack_error(json.loads(json.dumps(pack_error(MotionStopped("lost", "hold again", code="pad_lost")))))
    assert isinstance(stopped, MotionStopped)
    assert (stopped.code, stopped.reason, stopped.remedy) == ("pad_lost", "lost", "hold again")
    problem = Problem("rig.yaml", "robots.panda", "not known", "unknown_key")
    config = unpack_error(json.loads(json.dumps(pack_error(ConfigError([problem])))))
    assert isinstance(config, ConfigError)
    assert (config.code, config.problems) == ("config", (problem,))
