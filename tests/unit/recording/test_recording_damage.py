"""Files that are missing, truncated, damaged or made by an attacker: one DatasetError, or a correct result."""

from __future__ import annotations

import json
import os
import random
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from errors_kit import raises_code
from recording_kit import check_layout, drive, join_metadata, kill_writer, make_recording, mock_rig, record

from hal.errors import CommandError, ConnectionLost, DatasetError, DeviceNotFound, HalError
from hal.learning.replay import RecordedTrajectory
from hal.recording import Dataset, Episode, Recorder, recover, repair
from hal.recording.checking import check_dataset, check_rows
from hal.recording.exporters import export
from hal.recording.index import read_tasks
from hal.recording.review import draw_sheet, summarize
from hal.rig import Rig

FLIPS = int(os.environ.get("HAL_TEST_FLIPS", "20"))
"""Damaged bytes that are tried."""
Arrays = dict[str, np.ndarray[Any, Any]]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three finished episodes."""
    return make_recording(tmp_path_factory.mktemp("damage") / "demo").root


@pytest.fixture
def out(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "demo"))


@pytest.fixture(scope="module")
def rig() -> Iterator[Rig]:
    with mock_rig() as opened:
        yield opened


EACH = 2 + 2 + 2
"""Files of an episode: rows and own file, two videos, two of depth."""
INDEX = 4 + 1
"""Files of the index, and of the metadata that the episodes have in common."""


def files(root: Path, episodes: Sequence[int] = (0, 1, 2)) -> list[Path]:
    """Return the files of the index, and those of some episodes."""
    found = sorted(path for path in root.rglob("*") if path.is_file() and path.name != ".lock")
    assert len(found) == INDEX + 3 * EACH
    return [path for path in found if number_of(path) in (None, *episodes)]


def number_of(path: Path) -> int | None:
    """Return the number of the episode that a file belongs to; None for the index."""
    own = path.stem[-3:].isdecimal() and "meta" not in path.parts and "common" not in path.stem
    return int(path.stem[-3:]) if own else None


# What reads a dataset.


def rows(episode: Episode, folder: Path, rig: Rig) -> Arrays:
    return dict(episode.columns) | {f"stamps {name}": times for name, times in episode.stamps.items()}


def pictures(episode: Episode, folder: Path, rig: Rig) -> Arrays:
    found = {}
    for camera in ("scene", "wrist"):
        found[f"frames {camera}"] = np.stack(list(episode.frames(camera)))
        found[f"depth {camera}"] = np.stack(list(episode.depth(camera)))
    return found


def exported(episode: Episode, folder: Path, rig: Rig) -> Arrays:
    shutil.rmtree(folder / "npz", ignore_errors=True)
    made = export(Dataset(episode._layout.root), "npz", folder / "npz", episodes=[episode.number])
    with np.load(made.path / f"episode_{episode.number:06d}.npz") as arrays:
        return {name: arrays[name] for name in arrays.files if name != "info"}


def replayed(episode: Episode, folder: Path, rig: Rig) -> Arrays:
    check_rows(episode, None)
    course = RecordedTrajectory.from_episode(episode, rig.robots["panda"])
    assert course.grip is not None
    return {"t": course.t, "q_set": course.q_set, "grip": course.grip}


def drawn(episode: Episode, folder: Path, rig: Rig) -> Arrays:
    return {"sheet": np.array(draw_sheet(episode))}


READERS = (rows, pictures, exported, replayed, drawn)


@pytest.fixture(scope="module")
def right(whole: Path, rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> list[list[Arrays]]:
    """What each reader makes of each episode of the undamaged dataset."""
    folder = tmp_path_factory.mktemp("right")
    return [[read(episode, folder, rig) for read in READERS] for episode in Dataset(whole).episodes]


def same(a: Arrays, b: Arrays) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[key], b[key], equal_nan=a[key].dtype.kind == "f") for key in a)


def read_all(root: Path, number: int, right: list[list[Arrays]], folder: Path, rig: Rig) -> list[str]:
    """Read an episode in every way. What comes out is right, or a DatasetError; those are returned."""
    try:
        dataset = Dataset(root)
        broken = summarize(dataset).broken
        episode = dataset.episodes[number]
    except DatasetError as error:
        return [str(error)]
    errors = []
    for read, expected in zip(READERS, right[number], strict=True):
        try:
            found = read(episode, folder, rig)
        except DatasetError as error:
            errors.append(str(error))
        else:
            assert same(found, expected), read.__name__
    assert errors or not broken, "what the review calls broken cannot be read"
    return errors


def damaged(path: Path, how: str) -> None:
    content = path.read_bytes()
    if how == "deleted":
        path.unlink()
    else:
        size = {"empty": 0, "half": len(content) // 2, "one byte short": len(content) - 1}[how]
        path.write_bytes(content[:size])


EXTREMES = [pytest.param(how, marks=pytest.mark.slow) for how in ("half", "empty", "one byte short")]


@pytest.mark.parametrize("how", ["deleted", *EXTREMES])
def test_every_file_is_needed_or_its_damage_is_an_error(
    whole: Path, right: list[list[Arrays]], tmp_path: Path, rig: Rig, how: str
) -> None:
    root = Path(shutil.copytree(whole, tmp_path / "demo"))
    for original in files(whole, [1]):
        name = original.relative_to(whole)
        damaged(root / name, how)
        harmless = how == "one byte short" and name.suffix == ".json"  # the end of the line
        errors = read_all(root, number_of(name) or 0, right, tmp_path, rig)
        needed = name.parts[0] in ("data", "videos", "depth", "episodes") or name.name == "info.json"
        assert errors or harmless or not needed, f"{name} is {how}, and nothing said so"
        assert all(str(name) in error for error in errors), f"{name} is {how}: {errors}"
        found = checked(root)
        assert harmless or any(str(name) in error for error in found), f"{name} is {how}: {found}"
        shutil.copy(original, root / name)


def checked(root: Path) -> list[str]:
    try:
        return [str(error) for error in check_dataset(Dataset(root))]
    except DatasetError as error:
        return [str(error)]


@pytest.mark.slow
@pytest.mark.parametrize("exact", [True, False])
def test_a_changed_bit_is_an_error_or_changes_nothing(
    whole: Path, right: list[list[Arrays]], tmp_path: Path, rig: Rig, exact: bool
) -> None:
    """In a video, which has no checksums, and in JSON, it may be other valid content, but is no other error."""
    dice = random.Random(5 if exact else 6)
    originals = [path for path in files(whole) if exact == (path.suffix not in (".mp4", ".json"))]
    other = () if exact else (AssertionError, CommandError, DeviceNotFound)  # other numbers, other names
    seen = 0
    for _ in range(FLIPS):
        name = dice.choice(originals).relative_to(whole)
        root = Path(shutil.copytree(whole, tmp_path / "demo"))
        flip(root / name, dice)
        try:
            seen += bool(read_all(root, number_of(name) or 0, right, tmp_path, rig))
        except other:
            seen += 1
        checked(root)
        shutil.rmtree(root)
    assert seen > FLIPS / (4 if exact else 10)


def flip(path: Path, dice: random.Random) -> None:
    content = bytearray(path.read_bytes())
    content[dice.randrange(len(content))] ^= 1 << dice.randrange(8)
    path.write_bytes(content)


# A lost index.


def index_files(root: Path) -> dict[str, Any]:
    """The content of ``meta/``, without the order of bytes in files."""
    info, stats = (json.loads((root / f"meta/{name}.json").read_text()) for name in ("info", "stats"))
    flat = {f"{key} {part}": np.array(value).ravel() for key, found in stats.items() for part, value in found.items()}
    return {"info": info, "tasks": read_tasks(root / "meta/tasks.parquet"), "stats": flat}


@pytest.mark.parametrize("lost", ["meta/info.json", "meta/stats.json", "meta/tasks.parquet", "meta"])
def test_nothing_is_recorded_over_episodes_whose_index_is_lost(out: Path, rig: Rig, lost: str) -> None:
    before = {path: path.read_bytes() for path in files(out)}
    path = out / lost
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    with pytest.raises(DatasetError) as caught:
        Recorder(rig, out, fps=20)
    assert caught.value.code in ("index_missing", "index_wrong")
    assert caught.value.file is not None
    assert caught.value.file.startswith("meta/")
    assert recover(out) == [], "no unfinished episode, and only repair rebuilds the index"
    left = {path: path.read_bytes() for path in before if path.exists()}
    assert left == {path: before[path] for path in left}

    (done,) = repair(out)
    made = (
        "meta/stats.json was made again from" if lost == "meta/stats.json" else "the index was rebuilt from 3 episodes"
    )
    assert done.startswith(made)
    assert "; it was wrong: meta/" in done
    check_layout(out)
    assert checked(out) == []
    assert repair(out) == []
    if lost != "meta":
        return  # what is repaired is the same
    with Recorder(rig, out, fps=20, task="lift the cube") as recorder:
        record(recorder, 0.3)
        assert recorder.status().episode == 3
    check_layout(out)


@pytest.mark.parametrize(
    ("key", "name", "change"),
    [
        ("action", "mean", 1e-3),
        ("observation.images.wrist", "std", 0.01),
        ("rig.time.grid", "max", 0.1),
        ("action", "", 0),
    ],
)
def test_changed_statistics_are_noticed_and_made_again(
    whole: Path, out: Path, key: str, name: str, change: float
) -> None:
    file = out / "meta/stats.json"
    stats = json.loads(file.read_text())
    if name:
        stats[key][name] = (np.array(stats[key][name]) + change).tolist()
    else:
        del stats[key]
    file.write_text(json.dumps(stats))
    (error,) = checked(out)
    assert error.startswith("meta/stats.json: ")
    assert key in error
    (done,) = repair(out)
    assert key in done
    assert checked(out) == []
    old, new = index_files(whole)["stats"], index_files(out)["stats"]
    assert old.keys() == new.keys()
    assert all(np.allclose(values, new[key], atol=1e-7) for key, values in old.items())


def test_an_index_that_lists_fewer_episodes_than_there_are(out: Path, rig: Rig) -> None:
    file = out / "meta/info.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"total_episodes": 1, "total_frames": 14}))
    with raises_code(DatasetError, "index_wrong"):
        Recorder(rig, out, fps=20)
    assert any("is not in the index" in text for text in checked(out))
    earlier = out / "meta/episodes/chunk-000/file-007.parquet"
    shutil.copy(earlier.with_name("file-000.parquet"), earlier)
    assert "rebuilt from 3 episodes" in repair(out)[0]
    assert not earlier.exists(), "LeRobot would read it"
    assert check_layout(out)["total_episodes"] == 3


def test_an_index_cannot_be_rebuilt_without_every_episode(out: Path) -> None:
    (out / "meta/info.json").unlink()
    (out / "data/chunk-000/file-001.parquet").unlink()
    with pytest.raises(DatasetError, check=lambda error: error.file == "data/chunk-000/file-001.parquet"):
        repair(out)
    assert not (out / "meta/info.json").exists()


def test_episodes_of_an_older_version_need_the_names_of_their_columns(whole: Path, out: Path) -> None:
    join_metadata(out)
    for file in out.glob("episodes/*.json"):
        about = json.loads(file.read_text())
        del about["features"]
        file.write_text(json.dumps(about))
    (out / "meta/info.json").unlink()
    with pytest.raises(DatasetError, check=lambda error: error.file == "episodes/000000.json"):
        repair(out)
    info = json.loads((whole / "meta/info.json").read_text())
    (out / "meta/info.json").write_text(json.dumps(info | {"total_episodes": 1}))
    assert "rebuilt from 3 episodes" in repair(out)[0]
    assert json.loads((out / "meta/info.json").read_text()) == info


def test_an_interrupted_first_save_is_no_lost_index(out: Path, rig: Rig, tmp_path: Path) -> None:
    """The program was killed after it had moved all but ``info.json``."""
    with Recorder(rig, tmp_path / "one", fps=20) as recorder:
        record(recorder, 0.2)
    root = tmp_path / "one"
    partial = root / "episodes/000000.partial"
    (partial / "final").mkdir(parents=True)
    (root / "meta/info.json").rename(partial / "final/info.json")
    (partial / "list.json").write_text(json.dumps([["final/info.json", "meta/info.json"]]))
    with Recorder(rig, root, fps=20) as recorder:
        record(recorder, 0.2)
        assert recorder.notes == ["000000.partial was not finished: recovered as episode 0"]
    assert check_layout(root)["total_episodes"] == 2


# Folders made by an attacker.


@pytest.fixture(scope="module")
def torn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset with an episode whose writer was killed."""
    out = tmp_path_factory.mktemp("torn") / "demo"
    with mock_rig() as rig, Recorder(rig, out) as recorder:
        recorder.start()
        drive(rig, 0.5)
        kill_writer(recorder)
        with pytest.raises(ConnectionLost):
            recorder.save(wait=True)
    return out


@pytest.fixture
def trap(torn: Path, tmp_path: Path) -> tuple[Path, Path]:
    """A copy of that, and a file beside it that does not belong to it."""
    precious = tmp_path / "precious.mp4"
    precious.write_bytes(b"all my life" * 1000)
    return Path(shutil.copytree(torn, tmp_path / "demo")), precious


@pytest.mark.parametrize("place", ["../precious.mp4", "meta/../../precious.mp4", "{absolute}", "linked/precious.mp4"])
def test_a_list_moves_nothing_out_of_the_dataset(trap: tuple[Path, Path], rig: Rig, place: str) -> None:
    out, precious = trap
    before = precious.read_bytes()
    (out / "linked").symlink_to(precious.parent)
    (partial,) = out.glob("episodes/*.partial")
    place = place.replace("{absolute}", str(precious))
    (partial / "list.json").write_text(json.dumps([["rows.arrow", place]]))
    with raises_code(HalError, "damaged_episode"):
        recover(out)
    with raises_code(HalError, "damaged_episode"), Recorder(rig, out) as recorder:
        recorder.start()
    assert precious.read_bytes() == before
    assert (partial / "rows.arrow").exists()


@pytest.mark.parametrize("source", ["../../../precious.mp4", "{absolute}"])
def test_a_list_takes_nothing_from_elsewhere(trap: tuple[Path, Path], source: str) -> None:
    out, precious = trap
    (partial,) = out.glob("episodes/*.partial")
    moves = [[source.replace("{absolute}", str(precious)), "videos/x.mp4"]]
    (partial / "list.json").write_text(json.dumps(moves))
    with raises_code(HalError, "damaged_episode"):
        recover(out)
    assert precious.exists()


@pytest.mark.parametrize("target", ["data/chunk-000/file-001.parquet", "episodes/000002.json"])
def test_a_list_moves_nothing_over_a_finished_episode(out: Path, target: str) -> None:
    before = (out / target).read_bytes()
    partial = out / "episodes/000003.partial"
    partial.mkdir()
    (partial / "new").write_bytes(b"not an episode")
    (partial / "list.json").write_text(json.dumps([["new", target]]))
    with pytest.raises(HalError):
        recover(out)
    assert (out / target).read_bytes() == before


@pytest.mark.parametrize("what", ["camera", "link", "folder", "final", "lock"])
def test_no_file_elsewhere_is_cut_off_or_written(trap: tuple[Path, Path], what: str) -> None:
    out, precious = trap
    before = precious.read_bytes()
    (partial,) = out.glob("episodes/*.partial")
    if what == "camera":
        about = json.loads((partial / "about.json").read_text())
        about["cameras_kept"][0][0] = "../../../precious"
        (partial / "about.json").write_text(json.dumps(about))
    elif what == "link":
        (partial / "wrist.mp4").unlink()
        (partial / "wrist.mp4").symlink_to(precious)
    elif what == "folder":
        partial.rename(precious.parent / "elsewhere")
        partial.symlink_to(precious.parent / "elsewhere")
    elif what == "final":
        (partial / "final").mkdir()
        (partial / "final/about.json.new").symlink_to(precious)
    else:
        (out / "episodes/.lock").unlink()
        (out / "episodes/.lock").symlink_to(precious)
    with pytest.raises((HalError, OSError)):
        recover(out)
    assert precious.read_bytes() == before


def test_an_unfinished_episode_whose_description_is_damaged_is_kept(trap: tuple[Path, Path]) -> None:
    (partial,) = trap[0].glob("episodes/*.partial")
    (partial / "about.json").write_text("{")
    with raises_code(HalError, "damaged_episode"):
        recover(trap[0])
    assert (partial / "rows.arrow").stat().st_size > 0


@pytest.mark.parametrize(
    ("file", "change"),
    [
        ("meta/info.json", {"total_episodes": 10**15}),
        ("meta/info.json", {"total_episodes": "3"}),
        ("meta/info.json", {"fps": 0}),
        ("meta/info.json", {"features": []}),
        ("meta/info.json", {"features": {"../../x": {"dtype": "video", "shape": [1], "names": None}}}),
        ("meta/info.json", {"features": {"action": {"dtype": "float32", "shape": [10**12], "names": None}}}),
        ("episodes/000000.json", {"length": 10**12}),
        ("episodes/000000.json", {"length": "many"}),
        ("episodes/000000.json", {"cameras": {"../../../etc": {"K": [[1, 0, 0]] * 3, "distortion": []}}}),
        ("episodes/000000.json", {"cameras": ["scene"]}),
        ("episodes/000000.json", {"rig": {"resolved": {"robots": "panda"}}}),
        ("episodes/000000.json", {"t_start": None}),
        ("episodes/000000.json", {"task": {}}),
    ],
)
def test_json_of_another_shape_is_one_clear_error(out: Path, file: str, change: dict[str, Any]) -> None:
    path = out / file
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(DatasetError, check=lambda error: error.file in (file, "data/chunk-000/file-000.parquet")):
        rows(Dataset(out).episodes[0], out, None)  # type: ignore[arg-type]
    assert checked(out)


@pytest.mark.parametrize("text", ["[" * 100_000, "1" * 5000, "", "null", "[]", "\x00", '{"a": NaN}'])
def test_what_is_no_json_is_one_clear_error(out: Path, text: str) -> None:
    for file in ("meta/info.json", "episodes/000000.json"):
        before = (out / file).read_text()
        (out / file).write_text(text)
        with pytest.raises(DatasetError, check=lambda error, file=file: error.file == file):
            rows(Dataset(out).episodes[0], out, None)  # type: ignore[arg-type]
        (out / file).write_text(before)


@pytest.mark.parametrize("head", [b'{"width": 1000000, "height": 1000000, "unit_m": 0.001}', b"[]", b"x" * 10_000_000])
def test_a_depth_file_that_claims_too_much(out: Path, head: bytes) -> None:
    (out / "depth/wrist/chunk-000/file-000.depth").write_bytes(head + b"\n")
    with pytest.raises(DatasetError, check=lambda error: error.file == "depth/wrist/chunk-000/file-000.depth"):
        list(Dataset(out).episodes[0].depth("wrist"))
