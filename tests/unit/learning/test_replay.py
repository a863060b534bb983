"""Replaying an episode: how exactly, at which speed, under whose thumb, and what is refused before anything moves."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from errors_kit import raises_code

import hal
from hal.learning import replay as replay_module
from hal.learning.replay import Deviation, RecordedTrajectory, TrajectoryPlayer, list_other_arms, list_recorded_arms

FPS = 30
BARE = ["cameras={}"]


@dataclass
class Recorded:
    """An episode in memory, in the place of one on disk."""

    columns: dict[str, Any] = field(default_factory=dict)
    stamps: dict[str, Any] = field(default_factory=dict)
    info: dict[str, Any] = field(default_factory=dict)
    joints: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        self.length = len(self.stamps["robot.panda"])
        self.columns |= {f"rig.time.{name}": times for name, times in self.stamps.items()}

    def names(self, key: str) -> list[str]:
        other = {"observation.tcp": ["x", "y", "z", "qx", "qy", "qz", "qw"], "rig.setpoint_force": ["gripper"]}
        return other.get(key, [*self.joints, "gripper"])


def opened(driver: str, **options: Any) -> hal.Rig:
    kind: dict[str, Any] = {"driver": "mock"} if driver == "mock" else {"sim": True, "clock": "lock_step"}
    return hal.open("panda_table", **{"overrides": BARE, "pad": "none", **kind, **options})


def course_of(episode: Recorded, robot: hal.Robot) -> RecordedTrajectory:
    return RecordedTrajectory.from_episode(episode, robot)  # type: ignore[arg-type]


def twist(t: float) -> hal.Twist:
    return hal.Twist([0.12 * np.sin(1.5 * t), 0.15 * np.cos(2.0 * t), -0.05 * np.sin(t)], [0.0, 0.2 * np.sin(t), 0.3])


def record(
    driver: str = "mock", seconds: float = 4.0, cube: hal.Pose | None = None, rest: tuple[float, float] = (0.0, 0.0)
) -> Recorded:
    """Drive, close the hand half-way, and keep a row at every turn; the arm rests from some time to another one, s."""
    names = ("rig.setpoint", "rig.setpoint_force", "observation.state", "observation.tcp", "rig.object.cube")
    rows: dict[str, list[Any]] = {key: [] for key in names}
    stamps = []
    with opened(driver) as rig:
        arm = rig.robots["panda"]
        assert arm.gripper is not None
        if cube is not None:
            rig.world.reset("cube", pose=cube)
        with arm.control(rate_hz=FPS) as control:
            for tick in rig.clock.rate(FPS):
                rests = rest[0] <= tick.elapsed < rest[1]
                control.send(
                    hal.Twist([0.0] * 3) if rests else twist(tick.elapsed),
                    grip=0.0 if tick.elapsed < seconds / 2 else 0.8,
                )
                state, hand = arm.state(), arm.gripper.state()
                stamps.append(state.stamp.t)
                rows["rig.setpoint"].append([*state.q_set, hand.width_target])
                rows["rig.setpoint_force"].append([hand.force_target])
                rows["observation.state"].append([*state.q, hand.width])
                rows["observation.tcp"].append([*state.tcp.position, *state.tcp.orientation])
                if rig.has_world:
                    pose = rig.world.pose("cube")
                    rows["rig.object.cube"].append([*pose.position, *pose.orientation])
                if tick.elapsed > seconds:
                    break
        return Recorded(
            columns={key: np.array(values, np.float32) for key, values in rows.items() if values},
            stamps={"robot.panda": np.array(stamps)},
            info={"rig": {"resolved": {"robots": [{"name": "panda", "model": "panda"}]}}},
            joints=arm.joints,
        )


@pytest.fixture(scope="module")
def episode() -> Recorded:
    return record()


# How it goes.


@pytest.mark.parametrize(
    ("driver", "speed"),
    [
        ("mock", 0.5),
        ("simulation", 1.0),
        pytest.param("mock", 1.0, marks=pytest.mark.slow),
        pytest.param("simulation", 0.5, marks=pytest.mark.slow),
    ],
)
def test_a_replay_is_where_the_recording_was(driver: str, speed: float) -> None:
    episode = record(driver)
    with opened(driver) as rig:
        arm = rig.robots["panda"]
        player = TrajectoryPlayer(rig, arm, course_of(episode, arm), speed=speed)
        player.approach()
        start, widths = rig.clock.now(), []
        player.play(lambda player, plays: widths.append((player.progress, arm.gripper.state().width)))
        took = rig.clock.now() - start
    assert player.finished
    assert player.deviation.samples > 150
    assert player.deviation.rms.max() < 0.01
    assert player.deviation.tcp[0] < 0.01
    assert player.deviation.most.max() > 0.0, "it was measured"
    assert took == pytest.approx(player.trajectory.duration / speed, abs=1.5)
    recorded = episode.columns["observation.state"][:, -1]
    for place, width in widths:
        if not 1.9 < place < 2.8:  # not while the fingers are on their way, at a speed of their own
            assert width == pytest.approx(np.interp(place, player.trajectory.t, recorded), abs=0.012)


def test_an_arm_that_rested_for_the_fingers_waits_for_slower_ones() -> None:
    episode = record(rest=(1.0, 3.0))
    with opened("mock", overrides=[*BARE, "robots.panda.gripper.speed=0.02"]) as rig:
        arm = rig.robots["panda"]
        player = TrajectoryPlayer(rig, arm, course_of(episode, arm))
        (wait,) = player.trajectory.find_waits()
        player.approach()
        fastest = dict.fromkeys((False, True), 0.0)

        def on_turn(player: TrajectoryPlayer, plays: bool) -> None:
            late = arm.gripper.state().width > 0.02
            if late and player.progress > 1.7:
                assert player.progress < wait + 0.03
            if player.progress > 1.7:
                fastest[late] = max(fastest[late], float(np.abs(arm.state().dq_set).max()))

        player.play(on_turn)
        assert player.finished
        assert fastest[True] < 0.01, "it rests until they have closed"
        assert fastest[False] > 0.1
        assert player.deviation.tcp[0] < 0.01


def test_fingers_that_never_rest_end_the_replay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replay_module, "_LONGEST_WAIT", 0.5)
    episode = record(rest=(1.0, 3.0))
    with opened("mock", overrides=[*BARE, "robots.panda.gripper.speed=0.002"]) as rig:
        arm = rig.robots["panda"]
        player = TrajectoryPlayer(rig, arm, course_of(episode, arm))
        player.approach()
        with pytest.raises(hal.RobotFault, match="does not come to rest"):
            player.play()
        assert np.abs(arm.state().dq_set).max() < 1e-6


@pytest.mark.parametrize(
    ("faults", "text"),
    [
        ({"fail": "worn out"}, "failed, while the arm waits for its fingers: worn out"),
        ({"disconnect": True}, "failed, while the arm waits for its fingers: .* does not answer"),
        ({"freeze": True}, "does not come to rest, as it did in the recording: .* silent for"),
    ],
)
def test_fingers_that_fail_or_are_silent_do_not_let_the_arm_leave(
    monkeypatch: pytest.MonkeyPatch, faults: dict[str, Any], text: str
) -> None:
    monkeypatch.setattr(replay_module, "_LONGEST_WAIT", 1.0)
    episode = record(rest=(1.0, 3.0))
    with opened("mock") as rig:
        arm = rig.robots["panda"]
        player = TrajectoryPlayer(rig, arm, course_of(episode, arm))
        (wait,) = player.trajectory.find_waits()
        player.approach()

        def on_turn(player: TrajectoryPlayer, plays: bool) -> None:
            if 1.2 < player.progress < 1.5:
                rig.driver("panda.gripper").inject(**faults)
            assert player.progress < wait + 0.03

        with pytest.raises(hal.RobotFault, match=text):
            player.play(on_turn)
        assert np.abs(arm.state().dq_set).max() < 1e-6


def test_objects_are_put_back_to_their_recorded_poses() -> None:
    episode = record("simulation", seconds=1.0, cube=hal.Pose([0.15, 0.2, 0.63]))
    with opened("simulation") as rig:
        arm = rig.robots["panda"]
        away = rig.world.pose("cube").position[:2] - [0.15, 0.2]
        assert np.linalg.norm(away) > 0.05
        player = TrajectoryPlayer(rig, arm, course_of(episode, arm))
        player.approach()
        assert rig.world.pose("cube").position == pytest.approx(player.trajectory.objects["cube"].position, abs=1e-6)
        assert rig.world.pose("cube").position[:2] == pytest.approx([0.15, 0.2], abs=0.01)
        rig.world.remove("cube")
        with raises_code(hal.CommandError, "missing_object"):
            player.approach()


# Under whose thumb.


def test_releasing_the_dead_man_pauses_and_a_press_continues(episode: Recorded) -> None:
    with opened("mock", pad=None, overrides=[*BARE, "gamepads.pad.model=auto"]) as rig:
        arm, hand = rig.robots["panda"], rig.driver("pad")
        player = TrajectoryPlayer(rig, arm, course_of(episode, arm), deadman=rig.gamepads["pad"].hold("l2"))
        rig.clock.sleep(0.1)
        hand.press("l2")
        player.approach()
        before = arm.state().q
        turns, rest, places = 0, [], []

        def on_turn(player: TrajectoryPlayer, plays: bool) -> None:
            nonlocal turns
            turns += 1
            if turns == 25:  # what was held through the approach moves nothing
                assert player.progress == 0.0
                assert np.abs(arm.state().q - before).max() < 1e-6
                hand.release("l2")
            elif turns == 30:
                hand.press("l2")
            elif turns == 130:
                hand.release("l2")
            elif 150 < turns < 200:
                rest.append(arm.state().q)
                places.append(player.progress)
                assert not plays
            elif turns == 200:
                hand.press("l2")
            assert turns < 1000

        player.play(on_turn)
    assert player.finished
    assert player.pauses == 1
    assert np.ptp(rest, axis=0).max() < 1e-6, "at rest"
    assert len(set(places)) == 1
    assert 0.5 < places[0] < player.trajectory.duration - 0.5, "in the middle"
    assert player.deviation.rms.max() < 0.01, "and on from there"


def test_an_arm_that_waits_for_its_fingers_waits_on_after_a_pause() -> None:
    """The fingers stop in the pause, and have to close on after it."""
    episode = record(rest=(1.0, 3.0))
    slow = "robots.panda.gripper.speed=0.02"
    with opened("mock", pad=None, overrides=[*BARE, "gamepads.pad.model=auto", slow]) as rig:
        arm, hand = rig.robots["panda"], rig.driver("pad")
        player = TrajectoryPlayer(rig, arm, course_of(episode, arm), deadman=rig.gamepads["pad"].hold("l2"))
        (wait,) = player.trajectory.find_waits()
        rig.clock.sleep(0.1)
        hand.press("l2")
        player.approach()
        hand.release("l2")
        turns = paused = 0

        def on_turn(player: TrajectoryPlayer, plays: bool) -> None:
            nonlocal turns, paused
            turns += 1
            if turns == 5:
                hand.press("l2")
            if player.progress >= wait and not paused:
                paused = turns
                hand.release("l2")
            elif paused and turns == paused + 20:
                hand.press("l2")
            assert player.progress < wait + 0.05 or arm.gripper.state().width < 0.02
            assert turns < 2000

        player.play(on_turn)
    assert paused
    assert player.finished


@pytest.mark.parametrize("cause", ["pad", "stop", "program"])
def test_a_trip_ends_it(episode: Recorded, cause: str) -> None:
    with opened("mock", pad=None, overrides=[*BARE, "gamepads.pad.model=auto"]) as rig:
        arm, hand = rig.robots["panda"], rig.driver("pad")
        player = TrajectoryPlayer(rig, arm, course_of(episode, arm), deadman=rig.gamepads["pad"].hold("l2"))
        rig.clock.sleep(0.1)
        hand.press("l2")
        player.approach()
        hand.release("l2")
        turns = 0

        def on_turn(player: TrajectoryPlayer, plays: bool) -> None:
            nonlocal turns
            turns += 1
            assert turns < 500
            if turns == 5:
                hand.press("l2")
            if turns == 80:
                if cause == "pad":
                    hand.inject(freeze=True)
                elif cause == "stop":
                    rig.stop()
                else:
                    rig.clock.sleep(1.0)  # this program hangs

        trips = {"pad": hal.Trip.DEADMAN_SILENT, "stop": hal.Trip.STOP, "program": hal.Trip.COMMAND_LATE}
        with raises_code(hal.MotionStopped, trips[cause].code):
            player.play(on_turn)
        assert not player.finished
        assert np.abs(arm.state().dq_set).max() < 1e-9
        hand.inject(freeze=False)


# What is refused.


def test_what_cannot_be_replayed_is_refused_with_the_reason(episode: Recorded) -> None:
    with opened("mock") as rig:
        arm = rig.robots["panda"]
        good = course_of(episode, arm)
        good.check(arm, 1.0)

        def moved(k: int, j: int, value: float) -> np.ndarray:
            q = good.q_set.copy()
            q[k, j] = value
            return q

        wrong: list[tuple[RecordedTrajectory, str]] = [
            (replace(good, model="fr3"), "model fr3"),
            (replace(good, joints=("a", "b")), "joints a, b"),
            (replace(good, q_set=moved(20, 3, 0.5)), "panda_joint4 goes through .* its limits here"),
            (replace(good, q_set=moved(20, 3, np.nan)), "not a number"),
            (replace(good, t=good.t[:1], q_set=good.q_set[:1]), "nothing to replay"),
            (replace(good, tcp=good.tcp + 0.03), "another gripper or tool"),
        ]
        for trajectory, text in wrong:
            with pytest.raises(hal.CommandError, match=text):
                TrajectoryPlayer(rig, arm, trajectory)
        for speed in (0.0, -1.0, 1.5, np.nan):
            with raises_code(hal.CommandError, "bad_speed"):
                TrajectoryPlayer(rig, arm, good, speed=speed)


@pytest.mark.parametrize("limit", ["speed", "tcp_speed"])
def test_what_is_too_fast_here_names_the_speed_that_is_not(episode: Recorded, limit: str) -> None:
    with opened("mock", overrides=[*BARE, f"robots.panda.{limit}=0.05"]) as rig:
        arm = rig.robots["panda"]
        trajectory = course_of(episode, arm)
        with pytest.raises(hal.CommandError, match="at speed [0-9.]+ it could") as refused:
            TrajectoryPlayer(rig, arm, trajectory)
        possible = float(str(refused.value).rpartition("at speed ")[2].split()[0])
        TrajectoryPlayer(rig, arm, trajectory, speed=possible)


def test_what_leaves_the_workspace_here_is_refused(episode: Recorded) -> None:
    low, high = np.sort(episode.columns["observation.tcp"][:, 2])[[0, -1]]
    assert high - low > 0.02
    for height, refused in ((high - 0.01, True), (low - 0.001, False)):
        with opened("mock", overrides=[*BARE, f"robots.panda.workspace.table_height={height}"]) as rig:
            trajectory = course_of(episode, rig.robots["panda"])
            with pytest.raises(hal.CommandError, match="z of the tcp is") if refused else contextlib.nullcontext():
                trajectory.check(rig.robots["panda"], 1.0)


def test_an_arm_without_a_gripper_does_not_replay_one_that_has_it(episode: Recorded) -> None:
    with opened("mock") as rig:
        arm = rig.robots["panda"]
        trajectory = course_of(episode, arm)
        arm.gripper = None
        with raises_code(hal.CommandError, "cannot_replay"):
            trajectory.check(arm, 1.0)


def test_one_arm_of_two_is_found_by_its_name(episode: Recorded) -> None:
    with opened("mock") as rig:
        arm = rig.robots["panda"]
        single = course_of(episode, arm)

        @dataclass
        class Two(Recorded):
            def names(self, key: str) -> list[str]:
                own = Recorded.names(self, key)
                return [f"{name}.{label}" for name in ("left", "panda") for label in own]

        both = {key: np.hstack([0.0 * rows, rows]) for key, rows in episode.columns.items()}
        two = Two(both, {"robot.left": 0.0 * episode.stamps["robot.panda"], **episode.stamps}, {}, episode.joints)
        trajectory = course_of(two, arm)
        assert trajectory.joints == single.joints
        for name in ("t", "q_set", "q", "tcp", "grip"):
            assert getattr(trajectory, name) == pytest.approx(getattr(single, name))
        assert list_recorded_arms(two) == ["left", "panda"]  # type: ignore[arg-type]
        assert list_other_arms(two, "panda") == [], "the other one stood still"  # type: ignore[arg-type]
        assert list_other_arms(two, "left") == ["panda"]  # type: ignore[arg-type]
        assert list_other_arms(episode, "left") == [], "there is no other"  # type: ignore[arg-type]
        arm.name = "right"
        with raises_code(hal.CommandError, "no_such_arm"):
            course_of(two, arm)


def test_the_deviation_is_that_of_the_samples() -> None:
    deviation = Deviation(["a", "b"])
    assert deviation.as_json()["joints_rad"] is None
    for off in (0.03, -0.04):
        deviation.add(np.array([off, 0.0]), np.array([0.0, off, 0.0]))
    assert deviation.rms == pytest.approx([np.sqrt(0.00125), 0.0])
    assert deviation.most == pytest.approx([0.04, 0.0])
    assert deviation.as_json()["tcp_mm"] == pytest.approx({"rms": 1e3 * np.sqrt(0.00125), "max": 40.0})
    assert any("40.00 mm" in line for line in deviation.lines())


def test_every_stretch_is_monotone_and_its_two_ways_agree() -> None:
    from hal.learning.replay import TimeScaling

    scaling = TimeScaling(t=10.0, s=2.0, speed=0.5)
    times: Callable[[float], float] = scaling.time_at
    places = [scaling.progress_at(t) for t in np.arange(9.5, 14.0, 0.01)]
    assert (np.diff(places) >= 0.0).all()
    assert places[0] == 2.0
    for s in np.arange(2.0, 4.0, 0.01):
        assert scaling.progress_at(times(s)) == pytest.approx(s)
    assert np.diff(places)[-1] == pytest.approx(0.005)


# How fast an episode is: stamps that jitter make nothing faster, and what is really faster is refused.


def driven(speed: float, late: float = 0.0, seconds: float = 3.0) -> Recorded:
    """A joint at ``speed``, there and back; single rows are measured up to ``late`` s late, as on a busy machine."""
    with opened("mock") as rig:
        arm = rig.robots["panda"]
        start, joints, n, place = arm.state().q, arm.joints, arm.n, arm.state().tcp.position
    t = np.arange(0.0, seconds, 1.0 / FPS)
    q = np.tile(np.append(start, 0.04), (len(t), 1))
    q[:, n - 1] += speed * (np.minimum(t, seconds / 2) - np.maximum(t - seconds / 2, 0.0))
    tcp = np.tile([*place, 1.0, 0.0, 0.0, 0.0], (len(t), 1))
    stamps = t + np.random.default_rng(1).uniform(0.0, late, len(t))
    columns = {"rig.setpoint": q, "observation.state": q, "observation.tcp": tcp}
    return Recorded(
        {key: rows.astype(np.float32) for key, rows in columns.items()}, {"robot.panda": stamps}, {}, joints
    )


def test_rows_whose_stamps_jitter_are_no_faster_than_they_were() -> None:
    with opened("mock") as rig:
        arm = rig.robots["panda"]
        most = arm.spec.speed * arm.limits.velocity[-1]
        trajectory = course_of(driven(most, late=0.008), arm)
        rows = np.abs(np.diff(trajectory.q_set[:, -1])) / np.diff(trajectory.t)
        assert rows.max() > 1.1 * most, "from row to row it seems to be"
        trajectory.check(arm, 1.0)


@pytest.mark.parametrize("times", [1.06, 1.5, 5.0])
@pytest.mark.parametrize("late", [0.0, 0.008])
def test_what_is_really_faster_is_refused(times: float, late: float) -> None:
    with opened("mock") as rig:
        arm = rig.robots["panda"]
        most = arm.spec.speed * arm.limits.velocity[-1]
        trajectory = course_of(driven(times * most, late, seconds=2.4 / times), arm)
        with pytest.raises(hal.CommandError, match=r"panda_joint7 moves at .* at speed [0-9.]+ it could") as refused:
            trajectory.check(arm, 1.0)
        possible = float(str(refused.value).rpartition("at speed ")[2].split()[0])
        assert possible == pytest.approx(1.0 / times, rel=0.15)
        trajectory.check(arm, possible)


@pytest.mark.parametrize("row", [1, 40, -1])
def test_a_leap_is_refused_wherever_it_is(row: int) -> None:
    with opened("mock") as rig:
        arm = rig.robots["panda"]
        trajectory = course_of(driven(0.1), arm)
        q = trajectory.q_set.copy()
        q[row:, -1] += 0.2
        with raises_code(hal.CommandError, "cannot_replay"):
            replace(trajectory, q_set=q).check(arm, 1.0)
