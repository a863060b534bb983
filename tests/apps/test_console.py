"""The app with its console, as a person starts it: the link that it prints, and what it says of it."""

from __future__ import annotations

import asyncio
import json
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import aiohttp
import pytest

ROOT = Path(__file__).resolve().parents[2]
APP = ROOT / "apps" / "teleop.py"
LINK = re.compile(r"http://\S+/#\S+")


@contextmanager
def teleop(*arguments: str) -> Iterator[tuple[str, str]]:
    """The app, without cameras: what it printed until it drives, and the link."""
    command = [sys.executable, str(APP), "--sim", "--set", "cameras={}", "--listen", ":0", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        assert process.stdout is not None
        printed, link = "", ""
        for line in process.stdout:
            printed += line
            found = LINK.search(line)
            if found:
                link = found.group()
                break
        assert link, printed
        yield printed, link
        process.send_signal(signal.SIGINT)
        rest, _ = process.communicate(timeout=30)
        assert process.returncode == 0, rest
        assert "Traceback" not in rest
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()


def hello(link: str) -> dict[str, Any]:
    """What a page that is opened by this link hears first."""
    parts = urlsplit(link)
    port = parts.port

    async def ask() -> dict[str, Any]:
        origin = f"http://127.0.0.1:{port}"
        async with aiohttp.ClientSession() as session:
            async with session.get(f"{origin}/") as answer:
                assert answer.status == 200
                assert "<title>" in await answer.text()
            protocols = ("hal.v1", parts.fragment)
            async with session.ws_connect(f"{origin}/live", protocols=protocols, origin=origin) as page:
                return dict(json.loads((await page.receive(timeout=10.0)).data))

    return asyncio.run(ask())


@pytest.mark.slow
def test_without_a_pad_the_app_prints_a_link_that_works_and_a_tunnel() -> None:
    with teleop("--pad", "web") as (printed, link):
        assert "hold Space (L2) to move" in printed
        assert "Open this in a browser to drive" in printed
        assert urlsplit(link).hostname == "127.0.0.1"
        rig = hello(link)["rig"]
    assert (rig["sim"], rig["drivable"], rig["demo"]) == (True, True, True)
    assert [robot["name"] for robot in rig["robots"]] == ["panda"]


@pytest.mark.slow
def test_beside_another_pad_it_only_shows_and_stops() -> None:
    tour = str(ROOT / "tests" / "data" / "pads" / "tour.jsonl")
    with teleop("--pad", tour, "--console") as (printed, link):
        assert "Open this in a browser to watch and stop" in printed
        rig = hello(link)["rig"]
    assert rig["drivable"] is False
    assert rig["driven_by"]


@pytest.mark.slow
def test_on_another_interface_it_warns() -> None:
    with teleop("--pad", "web", "--listen", "0.0.0.0:0") as (printed, link):
        assert "encrypted" in printed
        assert "ssh -L" not in printed
        assert hello(link)["rig"]["drivable"] is True


def test_in_lock_step_there_is_nobody_to_drive() -> None:
    command = [sys.executable, str(APP), "--sim", "--pad", "web", "--set", "simulation.clock=lock_step"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert "real time" in done.stderr
    assert "Traceback" not in done.stderr
