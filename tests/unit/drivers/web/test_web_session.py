"""The rules of the console without a socket: whose pad counts, what the app and the pages are sent."""

from __future__ import annotations

import json
from typing import Any

import pytest

from hal.drivers.web.messages import MESSAGES_LATE, PAGE_SILENT, MalformedMessage
from hal.drivers.web.session import SendQueue, WebPage, WebSession, make_app_queue

RIG: dict[str, Any] = {"drivable": True, "driven_by": None, "demo": True, "cameras": []}
RIG |= {"robots": [{"name": "panda"}, {"name": "ur5"}]}


class App:
    """Reads at once, while ``reads`` is True."""

    def __init__(self) -> None:
        self.queue = make_app_queue()
        self.told: list[dict[str, Any]] = []
        self.reads = True

    def flush(self) -> None:
        while self.reads and (message := self.queue.pop()) is not None:
            self.told.append(message)

    def news(self) -> list[dict[str, Any]]:
        """Return the messages since the last call."""
        told, self.told = self.told, []
        return told

    def pads(self) -> list[object]:
        """The same, of the pad only: the page that it is of, or why it is gone."""
        pads = [message["pad"] for message in self.news() if "pad" in message]
        return [pad["from"] if pad["connected"] else (pad["why"],) for pad in pads]


class Room:
    """A session, the app behind it, and a clock."""

    def __init__(self, **rig: Any) -> None:
        self.now = 100.0
        self.app = App()
        self.session = WebSession({**RIG, **rig}, self.app.queue, self.app.flush, lambda: self.now)
        self.cut: list[int] = []

    def page(self) -> WebPage:
        number = len(self.session.pages) + 1
        return self.session.open_page(lambda: self.cut.append(number))

    def driver(self) -> WebPage:
        """A page that opens and drives, with its pad there."""
        page = self.page()
        self.say(page, type="lease", take=True)
        self.pad(page, self.now)
        self.app.news()
        inbox(page)
        return page

    def say(self, page: WebPage, **message: Any) -> None:
        self.session.receive(page, json.dumps(message))

    def pad(self, page: WebPage, seen: float, since: float = 0.0, axes: list[float] | None = None) -> None:
        axes = [0.0] * 16 if axes is None else axes
        self.say(page, type="pad", seen=seen, since=since, axes=axes, buttons=0, hands={})


@pytest.fixture
def room() -> Room:
    return Room()


def inbox(page: WebPage) -> list[dict[str, Any]]:
    """Everything that waits for a page."""
    return [json.loads(text) for text in iter(page.queue.pop, None)]


def test_a_page_that_opens_gets_everything_in_order(room: Room) -> None:
    room.driver()
    room.session.receive_from_app({"method": "labels", "labels": {"deadman": "l2", "controls": {}}})
    for k in range(60):
        room.session.receive_from_app({"method": "say", "t": float(k), "text": f"word {k}"})
    room.session.receive_from_app({"method": "waiting", "controls": ["r2"]})
    told = inbox(room.page())
    hello, lease, labels, pad, *says = told
    assert (hello["type"], hello["page"], hello["name"], hello["rig"]) == ("hello", 2, "page 2", RIG)
    assert labels == {"type": "labels", "deadman": "l2", "controls": {}}
    assert lease == {"type": "lease", "driver": "page 1", "you": False, "t": 100.0, "why": ""}
    assert pad == {"type": "pad", "waiting": ["r2"]}
    assert [say["text"] for say in says] == [f"word {k}" for k in range(10, 60)]


def test_only_the_pad_of_the_page_that_drives_counts(room: Room) -> None:
    driver, other = room.driver(), room.page()
    inbox(other)
    room.pad(other, 100.0)
    assert (room.app.news(), inbox(other)) == ([], [])
    room.now = 100.02
    room.pad(driver, 100.0, 20.0, [0.5, 0, 0, 0, 1, 0, 0, -1, *[0] * 8])
    axes = (0.5, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, -1.0, *[0.0] * 8)
    pad = {"connected": True, "t": 100.02, "t_alive": 100.02, "axes": axes, "buttons": 0, "hands": {}, "from": "page 1"}
    assert (room.app.news(), inbox(driver)) == ([{"pad": pad}], [{"type": "beat", "t": 100.02}])


def test_a_late_message_is_no_pad_but_is_answered(room: Room) -> None:
    driver = room.driver()
    room.now = 100.3
    room.pad(driver, 100.0, 20.0, [1.0] * 16)
    room.pad(driver, 100.0, 40.0, [1.0] * 16)
    assert room.app.pads() == [(MESSAGES_LATE,)]
    assert inbox(driver) == [{"type": "beat", "t": 100.3}]
    room.pad(driver, 100.3)
    assert room.app.pads() == ["page 1"]


def test_a_gap_is_reported_before_the_message_that_ends_it(room: Room) -> None:
    driver = room.driver()
    room.now = 100.5
    room.pad(driver, 100.0, 500.0)
    assert room.app.pads() == [(PAGE_SILENT,), "page 1"]


def test_silence_is_reported_by_the_regular_check(room: Room) -> None:
    room.driver()
    room.session.check_pad(100.1)
    assert room.app.news() == []
    room.session.check_pad(100.2)
    room.session.check_pad(100.25)
    assert room.app.pads() == [(PAGE_SILENT,)]


@pytest.mark.parametrize("why", ["hidden", "blur", "closing"])
def test_the_pad_of_a_page_that_left_is_lost_until_its_next_message(room: Room, why: str) -> None:
    driver = room.driver()
    room.say(room.page(), type="away", why=why)
    assert room.app.news() == [], "it does not drive"
    room.say(driver, type="away", why=why)
    room.say(driver, type="away", why=why)
    (gone,) = room.app.pads()
    assert "page" in gone[0]
    room.now = 100.02
    room.pad(driver, 100.0, 20.0)
    assert room.app.pads() == ["page 1"]


def test_taking_control_loses_the_pad_in_between(room: Room) -> None:
    first, second = room.driver(), room.page()
    inbox(second)
    room.now = 100.01
    room.say(second, type="lease", take=True)
    told = room.app.news()
    room.say(second, type="lease", take=True)
    assert room.app.news() == [], "it has control already"
    assert told[0]["pad"]["why"] == "page 2 took control"
    assert not told[0]["pad"]["connected"]
    assert told[1:] == [{"driver": "page 2"}]
    why = "page 2 took control"
    assert inbox(first) == [{"type": "lease", "driver": "page 2", "you": False, "t": 100.01, "why": why}]
    assert inbox(second)[0]["you"]
    room.pad(first, 100.0, 10.0, [1.0] * 16)
    assert room.app.news() == [], "what was on its way counts no more"
    assert inbox(first) == [], "and is not answered"
    room.pad(second, 100.01)
    assert room.app.pads() == ["page 2"]


def test_messages_from_before_control_was_taken_back_do_not_count(room: Room) -> None:
    first, second = room.driver(), room.page()
    room.now = 100.01
    room.say(second, type="lease", take=True)
    room.now = 100.02
    room.say(first, type="lease", take=True)
    room.app.news()
    room.pad(first, 100.0, 20.0, [1.0] * 16)
    assert room.app.news() == []
    room.pad(first, 100.02)
    assert room.app.pads() == ["page 1"]


@pytest.mark.parametrize("how", ["let go", "leave"])
def test_no_page_drives_after_the_driver_released_or_left(room: Room, how: str) -> None:
    driver, other = room.driver(), room.page()
    inbox(other)
    if how == "let go":
        room.say(driver, type="lease", take=False)
    else:
        room.session.close_page(driver)
        room.session.close_page(driver)
    gone, free = room.app.news()
    assert not gone["pad"]["connected"]
    assert gone["pad"]["why"] == (
        "page 1 released control" if how == "let go" else "the page in control is no longer connected"
    )
    assert free == {"driver": None}
    (lease,) = inbox(other)
    assert (lease["driver"], lease["you"]) == (None, False)
    room.pad(driver, 100.0, 0.0, [1.0] * 16)
    assert room.app.news() == []


def test_where_another_pad_drives_pages_only_watch_and_stop() -> None:
    room = Room(drivable=False, driven_by="DualShock 4", demo=False)
    page = room.page()
    inbox(page)
    room.say(page, type="lease", take=True)
    room.say(page, type="recover", robot="panda")
    room.say(page, type="demo", play=True)
    assert room.app.news() == []
    refused = inbox(page)
    assert [message["type"] for message in refused] == ["refused"] * 3
    assert "DualShock 4" in refused[0]["why"]
    room.say(page, type="stop")
    assert room.app.news() == [{"stop": "page 1"}]


def test_every_page_stops_and_only_the_driver_recovers_and_plays(room: Room) -> None:
    driver, other = room.driver(), room.page()
    inbox(other)
    room.say(other, type="stop")
    room.say(other, type="recover", robot="panda")
    room.say(other, type="demo", play=True)
    assert (room.app.news(), len(inbox(other))) == ([{"stop": "page 2"}], 2)
    room.say(driver, type="recover", robot="ur5")
    room.say(driver, type="demo", play=False)
    assert room.app.news() == [{"recover": "ur5", "page": "page 1"}, {"demo": False, "page": "page 1"}]


@pytest.mark.parametrize(
    "message",
    [
        {"type": "recover", "robot": "iiwa"},
        {"type": "watch", "cameras": {}},
        {"type": "drawn", "camera": "scene"},
        {"type": "pad", "seen": 100.5, "since": 0, "axes": [0] * 16, "buttons": 0, "hands": {}},
    ],
)
def test_malformed_here(room: Room, message: dict[str, Any]) -> None:
    driver = room.driver()
    with pytest.raises(MalformedMessage):
        room.say(driver, **message)
    assert (room.app.news(), inbox(driver)) == ([], [])


def test_messages_of_the_app_reach_their_pages(room: Room) -> None:
    first, second = room.page(), room.page()
    inbox(first), inbox(second)
    room.session.receive_from_app({"method": "refused", "page": "page 2", "why": "it is too late"})
    room.session.receive_from_app({"method": "refused", "page": "page 9", "why": "gone"})
    room.session.receive_from_app({"method": "playing", "on": True})
    room.session.receive_from_app({"method": "say", "t": 1.0, "text": "home"})
    room.session.send_state({"t": 100.0})
    say, state = {"type": "say", "t": 1.0, "text": "home"}, {"type": "state", "t": 100.0, "pages": 2, "playing": True}
    assert inbox(first) == [say, state]
    assert inbox(second) == [{"type": "refused", "why": "it is too late"}, say, state]


# A recording.


def recording(k: int = 0, *actions: str) -> dict[str, Any]:
    """The app shows how it goes."""
    return {"method": "recording", "t": float(k), "view": {"phase": "recording", "frames": k, "actions": list(actions)}}


def test_every_page_gets_the_newest_view_of_a_recording(room: Room) -> None:
    page = room.page()
    assert "recording" not in {message["type"] for message in inbox(page)}, "there is none"
    for k in range(1000):
        room.session.receive_from_app(recording(k, "finish"))
    newest = {"type": "recording", "t": 999.0, "phase": "recording", "frames": 999, "actions": ["finish"]}
    assert inbox(page) == [newest], "a slow page misses what is outdated, and nothing else"
    assert (room.cut, inbox(room.page())[-1]) == ([], newest)


def test_only_the_driver_steers_a_recording_by_its_possible_actions(room: Room) -> None:
    driver, other = room.driver(), room.page()
    inbox(other)
    room.say(driver, type="action", action="record")
    assert [message["why"] for message in inbox(driver)] == ["this program records nothing"]
    room.session.receive_from_app(recording(1, "finish", "discard"))
    inbox(driver), inbox(other)
    room.say(other, type="action", action="finish")
    room.say(driver, type="action", action="record")
    assert room.app.news() == []
    assert "only the page in control" in inbox(other)[0]["why"]
    assert "cannot be done now" in inbox(driver)[0]["why"]
    room.say(driver, type="action", action="finish")
    assert (room.app.news(), inbox(driver)) == ([{"action": "finish", "page": "page 1"}], [])
    room.session.receive_from_app(recording(2))
    room.say(driver, type="action", action="finish")
    assert room.app.news() == [], "twice is once"


def test_a_view_with_nan_changes_nothing(room: Room) -> None:
    page = room.page()
    room.session.receive_from_app(recording(1, "finish"))
    newest = inbox(page)[-1]
    wrong = recording(2, "record")
    wrong["view"]["seconds"] = float("nan")
    with pytest.raises(ValueError, match="JSON"):
        room.session.receive_from_app(wrong)
    assert (inbox(page), inbox(room.page())[-1]) == ([], newest)


def test_only_the_page_in_control_sets_only_what_the_program_offers(room: Room) -> None:
    driver, other = room.driver(), room.page()
    view = {"robot": "panda", "speed": 0.5, "speed_max": 1.0, "frame": "base", "settings": ["speed"]}
    room.session.receive_from_app({"method": "driving", "view": view})
    assert inbox(driver) == [{"type": "driving", **view}]
    assert {"type": "driving", **view} in inbox(room.page()), "a page that opens later sees it, too"
    inbox(other)
    room.say(other, type="setting", name="speed", value=0.1)
    room.say(driver, type="setting", name="scene", value="reset")
    assert room.app.news() == []
    assert [inbox(page)[0]["type"] for page in (other, driver)] == ["refused", "refused"]
    room.say(driver, type="setting", name="speed", value=0.1)
    assert room.app.news() == [{"setting": "speed", "value": 0.1, "page": "page 1"}]


# What waits for an app that does not read.


def test_an_app_that_reads_again_gets_the_loss_and_the_newest_pad(room: Room) -> None:
    driver = room.driver()
    room.app.reads = False
    for k in range(1, 200):
        room.now = 100.0 + 0.02 * k
        room.pad(driver, 100.0, 20.0 * k, [k / 200.0] * 16)
        if k == 50:
            room.say(driver, type="away", why="hidden")
        if k % 40 == 0:
            room.say(driver, type="stop")
    room.app.reads = True
    room.app.flush()
    stop, gone, pad = room.app.news()
    assert (stop, gone["pad"]["why"]) == ({"stop": "page 1"}, "the page was hidden")
    assert pad["pad"]["axes"][0] == 199 / 200.0


def test_a_loss_replaces_the_pad_before_it(room: Room) -> None:
    driver = room.driver()
    room.app.reads = False
    room.pad(driver, room.now)
    room.say(driver, type="away", why="hidden")
    room.app.reads = True
    room.app.flush()
    assert room.app.pads() == [("the page was hidden",)]


def test_requests_are_refused_while_the_app_does_not_read(room: Room) -> None:
    driver = room.driver()
    room.app.reads = False
    for _ in range(100):
        room.say(driver, type="recover", robot="panda")
    assert inbox(driver)[-1] == {"type": "refused", "why": "the program does not answer"}
    room.say(driver, type="stop")
    room.app.reads = True
    room.app.flush()
    told = room.app.news()
    assert told[0] == {"stop": "page 1"}
    assert 1 < len(told) < 20


# What waits for a page that does not read.


def test_beats_first_then_notes_in_order_then_the_newest_of_the_rest() -> None:
    queue = SendQueue(lambda: None)
    for k in range(3):
        queue.put_newest("state", f"state {k}")
        queue.put_newest("recording", f"recording {k}")
        queue.put_note(f"note {k}")
        queue.put_newest("beat", f"beat {k}")
    assert list(iter(queue.pop, None)) == ["beat 2", "note 0", "note 1", "note 2", "state 2", "recording 2"]


def test_a_page_that_misses_a_note_is_disconnected(room: Room) -> None:
    slow, other = room.page(), room.page()
    for k in range(300):
        room.session.receive_from_app({"method": "say", "t": 0.0, "text": f"word {k}"})
        inbox(other)
    assert set(room.cut) == {1}
    assert len(inbox(slow)) <= 256
