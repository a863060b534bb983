"""Benches of the mock, playback, console and terminal pads, for the contract."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from hal.drivers.mock.gamepad import MockPad
from hal.testing import PadBench, pad_spec


@contextmanager
def mock_pad() -> Iterator[PadBench]:
    driver = MockPad(pad_spec())
    yield PadBench(
        driver=driver,
        press=lambda: driver.press("south"),
        release=lambda: driver.release("south"),
        lose=lambda: driver.inject(disconnect=True),
        restore=lambda: driver.inject(disconnect=False),
        freeze=lambda: driver.inject(freeze=True),
    )
    driver.close()


RECORDED_PAD = """\
{"format": "hal-pad-events", "version": 1, "ranges": {"ABS_X": [0, 255]}, "model": {"name": "test", "title": "a test", \
"axes": {"ABS_X": "left_x"}, "buttons": {"BTN_SOUTH": "south"}}}
{"t": 0.5, "type": "abs", "code": "ABS_X", "value": 255}
{"t": 1.0, "type": "key", "code": "BTN_SOUTH", "value": 1}
{"t": 60.0, "type": "key", "code": "BTN_SOUTH", "value": 0}
"""


@contextmanager
def playback_pad() -> Iterator[PadBench]:
    """A recording whose file and options contain the events; the bench sets the time of each."""
    from hal.drivers.playback.pad import PlaybackPad

    with TemporaryDirectory() as folder:
        file = Path(folder) / "pad.jsonl"
        file.write_text(RECORDED_PAD)
        options = {"file": str(file), "disconnect_at": 2.0, "reconnect_at": 4.0, "freeze_at": 30.0}
        driver = PlaybackPad(pad_spec(driver="playback", options=options))
        bench = PadBench(driver=driver)
        start = bench.now

        def go_to(seconds: float) -> None:
            bench.now = start + seconds

        bench.press = lambda: None  # the recording presses it
        bench.lose = lambda: go_to(2.5)
        bench.restore = lambda: go_to(4.5)
        bench.freeze = lambda: go_to(30.0)
        yield bench
        driver.close()


@contextmanager
def web_pad() -> Iterator[PadBench]:
    """The pad of a console page, which sends its state every 10 ms."""
    from hal.drivers.web.pad import PadQueue, WebPad, pad_reading
    from hal.types import PAGE_AXES

    class Page:
        queue = PadQueue()
        driver = "page 1"
        stop_count = 0
        there, frozen, mask = True, False, 0

        def subscribe(self, hand: str) -> PadQueue:
            return self.queue

        def show_playing(self, on: bool) -> None:
            """No recording is played here."""

        def speak(self) -> None:
            now, axes = bench.now, [0.0] * len(PAGE_AXES)
            message = {
                "connected": self.there,
                "t": now,
                "t_alive": now,
                "axes": axes,
                "buttons": self.mask,
                "hands": {},
            }
            if not self.frozen:
                self.queue.put(pad_reading(message))

    page = Page()
    driver = WebPad(pad_spec(driver="web"), page)
    bench = PadBench(
        driver=driver,
        advance=page.speak,
        press=lambda: setattr(page, "mask", 1),
        release=lambda: setattr(page, "mask", 0),
        lose=lambda: setattr(page, "there", False),
        restore=lambda: setattr(page, "there", True),
        freeze=lambda: setattr(page, "frozen", True),
    )
    yield bench
    driver.close()


@contextmanager
def terminal_steps() -> Iterator[PadBench]:
    """The keys of a terminal."""
    from terminal_kit import FarEnd

    from hal.drivers.terminal.pad import TerminalPad

    with FarEnd() as far:
        driver = TerminalPad(pad_spec(driver="terminal", options={"tty": far.path}))
        yield PadBench(driver=driver, press=lambda: far.put("1"), lose=far.hang_up)
        driver.close()
