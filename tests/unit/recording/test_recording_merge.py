"""Merging of datasets, and a recorder that goes from one rig to another of the same configuration."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import resource
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from errors_kit import raises_code
from recording_kit import CAMERAS, check_layout, join_metadata, mock_rig, record

from hal.errors import CommandError, DatasetError
from hal.recording import (
    Dataset,
    Episode,
    Recorder,
    delete_episodes,
    mark_episodes,
    merge,
    merging,
    pack,
    repair,
    set_task,
)
from hal.recording import (
    dataset as dataset_module,
)
from hal.recording import (
    layout as layout_module,
)
from hal.recording.checking import check_dataset
from hal.recording.layout import DatasetLayout, lock_dataset

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")
RENUMBERED = {"episode_index", "index", "task_index"}


def pictures_of(episode: Episode, stream: str) -> bytes:
    return b"".join(picture.tobytes() for camera in CAMERAS for picture in episode.pictures(camera, stream))


@pytest.fixture(scope="module")
def part(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes of different tasks, of two rigs that one recorder recorded one after the other."""
    out = tmp_path_factory.mktemp("part") / "demo"
    with mock_rig() as first, Recorder(first, out, fps=20, task="lift") as recorder:
        record(recorder, 0.3, True)
        with mock_rig() as second:
            recorder.switch_rig(second)
            recorder.task = "lower"
            record(recorder, 0.4, None)
            with (
                mock_rig("lock_step", "cameras.wrist.output.width=32") as other,
                raises_code(CommandError, "other_rig"),
            ):
                recorder.switch_rig(other)
    return out


def test_a_recorder_switches_rigs(part: Path) -> None:
    one, two = Dataset(part).episodes
    assert one.stamps["grid"][0] == two.stamps["grid"][0] == 0.0, "each has a clock of its own"
    assert np.array_equal(one.columns["action"][:6], two.columns["action"][:6])
    assert all(one.info[key] is two.info[key] for key in ("rig", "features")), "in memory once"
    assert len(list(part.glob("episodes/common-*.json"))) == 1, "and on the disk"


def test_episodes_are_renumbered_and_nothing_else_changes(part: Path, tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    merged = tmp_path / "merged"
    assert merge([part, part], merged, on_episode=lambda *counts: seen.append(counts)) == 4
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]
    info = check_layout(merged)
    assert (info["total_episodes"], info["total_tasks"]) == (4, 2)
    for episode, source in zip(Dataset(merged).episodes, Dataset(part).episodes * 2, strict=True):
        assert (episode.task, episode.success) == (source.task, source.success)
        same = [key for key in source.columns if source.columns[key].tobytes() == episode.columns[key].tobytes()]
        assert set(source.columns) - set(same) <= RENUMBERED
        for stream in ("color", "depth"):
            assert pictures_of(episode, stream) == pictures_of(source, stream), "nothing is encoded again"
        for camera in CAMERAS:
            assert source.files(camera)["depth"].samefile(episode.files(camera)["depth"]), "nor copied"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["merged"]

    combined = json.loads((merged / "meta/stats.json").read_text())
    (merged / "meta/info.json").unlink()
    repair(merged)
    rebuilt = json.loads((merged / "meta/stats.json").read_text())
    assert rebuilt.keys() == combined.keys()
    for key, found in rebuilt.items():
        for part_of, values in found.items():
            assert np.allclose(values, combined[key][part_of], atol=1e-6), (key, part_of)


def test_a_key_sorts_and_takes_each_once(part: Path, tmp_path: Path) -> None:
    merged = tmp_path / "merged"
    assert merge([part, part], merged, key=lambda episode: episode.task[::-1]) == 2
    assert [episode.task for episode in Dataset(merged).episodes] == ["lower", "lift"]
    assert merge([merged, part], merged) == 4, "a part is replaced by the result"
    assert [episode.task for episode in Dataset(merged).episodes] == ["lower", "lift", "lift", "lower"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["merged"]
    check_layout(merged)


def test_what_cannot_be_merged_is_refused(part: Path, tmp_path: Path) -> None:
    copy, out = tmp_path / "copy", tmp_path / "out"
    shutil.copytree(part, copy)
    join_metadata(copy)
    with raises_code(CommandError, "output_exists"):
        merge([part], copy)
    with raises_code(CommandError, "no_folder"):
        merge([part, tmp_path / "nowhere"], out)
    (copy / "episodes/000002.partial").mkdir()
    with raises_code(CommandError, "unfinished_episodes"):
        merge([part, copy], out)
    (copy / "episodes/000002.partial").rmdir()
    info = json.loads((copy / "meta/info.json").read_text())
    (copy / "meta/info.json").write_text(json.dumps(info | {"fps": 10}))
    with raises_code(CommandError, "other_dataset"):
        merge([part, copy], out)
    (copy / "meta/info.json").write_text(json.dumps(info))
    about = json.loads((copy / "episodes/000000.json").read_text())
    changed = about | {"cameras": about["cameras"] | {"wrist": about["cameras"]["wrist"] | {"depth_unit_m": 0.01}}}
    (copy / "episodes/000000.json").write_text(json.dumps(changed))
    with raises_code(CommandError, "other_dataset"):
        merge([part, copy], out)
    (copy / "episodes/000000.json").write_text(json.dumps(about))
    (copy / "meta/info.json").write_text(json.dumps(info | {"total_episodes": 1}))
    with raises_code(DatasetError, "index_wrong"):
        pack(copy)
    (copy / "meta/info.json").write_text(json.dumps(info))
    (copy / "videos/observation.images.wrist/chunk-000/file-001.mp4").unlink()
    with pytest.raises(DatasetError) as damaged:
        merge([part, copy], out)
    assert damaged.value.episode == 1
    assert [path.name for path in tmp_path.iterdir()] == ["copy"], "nothing is left of the attempts"
    assert delete_episodes(copy, [1]) == 1, "a damaged episode can be deleted"
    assert not list(check_dataset(Dataset(copy)))


@pytest.mark.parametrize("change", ["no metadata in between", "a file of nobody", "damaged tasks"])
def test_what_would_lose_a_file_is_refused(part: Path, tmp_path: Path, change: str) -> None:
    demo = Path(shutil.copytree(part, tmp_path / "demo"))
    if change == "damaged tasks":
        os.truncate(demo / "meta/tasks.parquet", 40)
    elif change == "a file of nobody":
        shutil.copy(demo / "depth/wrist/chunk-000/file-000.depth", demo / "depth/wrist/chunk-000/file-007.depth")
    else:  # an older meta/info.json and a lost file: what is left of episode 3 would be removed
        merge([part, part], tmp_path / "four")
        shutil.copy(tmp_path / "four/episodes/000003.json", demo / "episodes")
        shutil.rmtree(tmp_path / "four")
    before = {path: path.stat().st_size for path in demo.rglob("*")}
    with pytest.raises(DatasetError) as refused:
        delete_episodes(demo, [0])
    assert refused.value.file == {
        "damaged tasks": "meta/tasks.parquet",
        "a file of nobody": "depth/wrist/chunk-000/file-007.depth",
    }.get(change, "episodes/000003.json")
    assert {path: path.stat().st_size for path in demo.rglob("*")} == before
    assert [path.name for path in tmp_path.iterdir()] == ["demo"]


@pytest.mark.parametrize("limit", [1_000, 12_000, 40_000])
def test_a_full_disk_is_not_reported_as_a_damaged_file(part: Path, tmp_path: Path, limit: int) -> None:
    """At the first limit videos cannot be written, at the second no rows, at the third no index."""
    demo = Path(shutil.copytree(part, tmp_path / "demo"))
    before = {path: path.stat().st_size for path in demo.rglob("*")}
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        with pytest.raises(OSError, match="too large") as refused:
            pack(demo)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert refused.value.errno == errno.EFBIG
    assert {path: path.stat().st_size for path in demo.rglob("*")} == before
    assert [path.name for path in tmp_path.iterdir()] == ["demo"]


def test_a_part_may_be_write_protected(part: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    demo, opened = Path(shutil.copytree(part, tmp_path / "demo")), os.open

    def protected(path: Any, flags: int, *rest: Any, **more: Any) -> int:
        if flags & (os.O_RDWR | os.O_CREAT) and Path(str(path)).is_relative_to(demo):
            raise OSError(errno.EROFS, "read-only file system")
        return opened(path, flags, *rest, **more)

    monkeypatch.setattr(layout_module.os, "open", protected)
    assert merge([demo], tmp_path / "out") == 2
    with pytest.raises(OSError, match="read-only"):
        delete_episodes(demo, [0])
    with lock_dataset(DatasetLayout(demo), only_read=True), monkeypatch.context() as patched:
        patched.setattr(layout_module, "_PATIENCE", 0.0)
        with raises_code(CommandError, "dataset_locked"):
            merge([demo], tmp_path / "again")


def test_joined_files_read_as_before_and_are_rebuilt_repaired_and_continued(
    part: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(merging, "GROUP", 3)
    demo = tmp_path / "demo"
    merge([part, part], demo)
    names = [[str(path.relative_to(demo)) for path in demo.glob(f"{kind}/*.*")] for kind in ("data/*", "videos/*/*")]
    assert [len(each) for each in names] == [2, len(CAMERAS)], "four episodes"
    assert not list(check_dataset(Dataset(demo)))
    places = [episode.place for episode in Dataset(demo).episodes]
    rows = demo / "data/chunk-000/file-000.parquet"
    before = rows.stat().st_ino, check_layout(demo)
    shutil.rmtree(demo / "meta")
    repair(demo)
    assert (rows.stat().st_ino, check_layout(demo)) == before

    with mock_rig() as rig, Recorder(rig, demo, fps=20, task="lift") as recorder:
        record(recorder, 0.3, False)
    check_layout(demo)
    assert [episode.place for episode in Dataset(demo).episodes[:4]] == places
    assert pack(demo) == 5
    assert rows.stat().st_ino == before[0], "a full file is linked"
    mark_episodes(demo, {4: True})
    assert Dataset(demo).episodes[4].columns["next.success"][-1], "the rows have the mark, too"
    delete_episodes(demo, [1, 2])
    check_layout(demo)
    assert not list(check_dataset(Dataset(demo)))
    first, _ = Dataset(part).episodes
    kept = Dataset(demo).episodes
    assert [episode.success for episode in kept] == [True, None, True]
    assert kept[2].columns["next.success"].tolist() == [False] * (kept[2].length - 1) + [True]
    assert pictures_of(kept[0], "color") == pictures_of(first, "color")
    assert len(list(demo.glob("videos/*/*/*.mp4"))) == len(CAMERAS)


@pytest.mark.parametrize("exchanged", [False, True])
def test_a_dataset_survives_a_kill_while_it_is_replaced(
    part: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exchanged: bool
) -> None:
    demo, exchange = Path(shutil.copytree(part, tmp_path / "demo")), layout_module._exchange

    def killed(one: Path, other: Path) -> bool:
        if exchanged:
            assert exchange(one, other)
        raise KeyboardInterrupt

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(layout_module, "_exchange", killed)
        patched.setattr(shutil, "rmtree", lambda *_, **__: None)
        pack(demo)
    assert check_layout(demo)["total_episodes"] == pack(demo) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["demo"]


def test_nothing_is_replaced_where_folders_cannot_be_exchanged(
    part: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    demo = Path(shutil.copytree(part, tmp_path / "demo"))
    with monkeypatch.context() as patched, pytest.raises(OSError, match="choose a new folder"):
        patched.setattr(layout_module, "_exchange", lambda *_: False)
        pack(demo)
    assert len(Dataset(demo)) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["demo"]


def test_a_reader_follows_joined_files_and_refuses_another_episode(
    part: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    demo = Path(shutil.copytree(part, tmp_path / "demo"))
    before, opened = Dataset(part), Dataset(demo)
    depth = opened.episodes[1].depth["wrist"]
    assert [episode.place.data for episode in opened.episodes] == [(0, 0), (1, 0)]
    pack(demo)
    mark_episodes(demo, {1: False})
    for one, other in zip(before.episodes, opened.episodes, strict=True):
        assert pictures_of(one, "color") == pictures_of(other, "color")
        assert np.array_equal(one.columns["action"], other.columns["action"])
    assert opened.episodes[1].frame("wrist", 2).tobytes() == before.episodes[1].frame("wrist", 2).tobytes()
    assert np.array_equal(depth[2], before.episodes[1].depth["wrist"][2])
    assert opened.episodes[1].place.data == (0, before.episodes[0].length)
    assert opened.episodes[1].success is False

    fresh, read_picture = Dataset(demo).episodes[0], dataset_module.read_picture

    def read_after_a_deletion(*args: Any) -> Any:
        delete_episodes(demo, [0])
        return read_picture(*args)

    fresh.files("wrist")
    with monkeypatch.context() as patched, raises_code(DatasetError, "dataset_changed"):
        patched.setattr(dataset_module, "read_picture", read_after_a_deletion)
        fresh.frame("wrist", 0)
    first = opened.episodes[0]
    for read in (lambda: next(first.frames("wrist")), lambda: first.frame("wrist", 0), first.read_table):
        with raises_code(DatasetError, "dataset_changed"):
            read()


def test_numbers_of_episodes_are_those_of_the_dataset_that_was_opened(part: Path, tmp_path: Path) -> None:
    demo = tmp_path / "demo"
    merge([part, part], demo)
    opened = Dataset(demo)
    delete_episodes(demo, [0])
    with raises_code(CommandError, "dataset_changed"):
        delete_episodes(opened, [0])
    assert len(Dataset(demo)) == 3


def test_a_lock_of_a_dataset_that_was_replaced_is_not_kept(
    part: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    demo, lock, calls = Path(shutil.copytree(part, tmp_path / "demo")), fcntl.flock, [0]

    def replaced_meanwhile(*args: Any) -> None:
        calls[0] += 1
        if calls[0] == 1:
            pack(demo)
        lock(*args)

    monkeypatch.setattr(layout_module.fcntl, "flock", replaced_meanwhile)
    with lock_dataset(DatasetLayout(demo)):
        monkeypatch.setattr(layout_module, "_PATIENCE", 0.0)
        with raises_code(CommandError, "dataset_locked"), lock_dataset(DatasetLayout(demo)):
            pass


def test_two_merges_into_one_folder_exclude_each_other(
    part: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = DatasetLayout(tmp_path / ".out.merging")
    monkeypatch.setattr(layout_module, "_PATIENCE", 0.0)
    with lock_dataset(place):
        (place.root / "data").mkdir()
        with raises_code(CommandError, "dataset_locked"):
            merge([part], tmp_path / "out")
        assert (place.root / "data").exists()
        with pytest.raises(FileExistsError):
            merging.link_file(part / "meta/info.json", place.episodes / ".lock")
    (place.root / "link").symlink_to("data")
    assert merge([part], tmp_path / "out") == 2, "what a killed program left is removed"
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["data", "depth", "episodes", "meta", "videos"]


def test_other_files_in_the_folder_stay(part: Path, tmp_path: Path) -> None:
    demo = Path(shutil.copytree(part, tmp_path / "demo"))
    (demo / "notes/monday").mkdir(parents=True)
    for name in ("README.md", "notes/monday/grasp.txt", "episodes/remark.txt"):
        (demo / name).write_text(name)
    (demo / "newest").symlink_to("notes/monday")
    delete_episodes(demo, [0])
    for name in ("README.md", "notes/monday/grasp.txt", "episodes/remark.txt"):
        assert (demo / name).read_text() == name
    assert (demo / "newest").readlink() == Path("notes/monday")
    assert check_layout(demo)["total_episodes"] == 1


def test_a_mount_point_is_not_replaced(part: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    demo = Path(shutil.copytree(part, tmp_path / "demo"))

    def not_linked(source: Path, target: Path) -> None:
        raise OSError(errno.EXDEV, "another file system")

    monkeypatch.setattr(merging, "LOOSE", 1)
    with monkeypatch.context() as patched:
        patched.setattr(os, "link", not_linked)
        merging.pack_if_loose(demo)
        assert len(list(demo.glob("data/*/*"))) == 2, "not by itself: all files would be copied"
        patched.setattr(Path, "is_mount", lambda path: path == demo)
        with raises_code(CommandError, "mount_point"):
            pack(demo)
    assert [path.name for path in tmp_path.iterdir()] == ["demo"]
    merging.pack_if_loose(demo)
    assert len(list(demo.glob("data/*/*"))) == 1


def test_rows_stay_in_their_file_only_if_nothing_in_it_changes(
    part: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(merging, "GROUP", 2)
    demo = tmp_path / "demo"
    merge([part, part], demo)

    def tasks_of_rows() -> list[str]:
        found = pq.read_table(demo / "meta/tasks.parquet").to_pydict()
        texts = dict(zip(found["task_index"], found["__index_level_0__"], strict=True))
        rows = pq.read_table(demo / "data")["task_index"].to_pylist()
        assert len(rows) == sum(map(len, Dataset(demo).episodes)), "no row of a deleted episode is left"
        return [texts[row] for row in rows]

    set_task(demo, "lower", [0])  # which is now the first task, also for the rows of the other file
    assert not list(check_dataset(Dataset(demo)))
    assert tasks_of_rows() == [episode.task for episode in Dataset(demo).episodes for _ in range(episode.length)]
    delete_episodes(demo, [3])
    assert tasks_of_rows() == [episode.task for episode in Dataset(demo).episodes for _ in range(episode.length)]
    table = pq.read_table(demo / "data/chunk-000/file-001.parquet")
    pq.write_table(pa.concat_tables([table, table]), demo / "data/chunk-000/file-001.parquet")
    assert [error.file for error in check_dataset(Dataset(demo))] == ["meta/info.json"], "LeRobot counts all rows"
    swapped = table.set_column(table.schema.get_field_index("task_index"), "task_index", pa.array([0] * len(table)))
    pq.write_table(swapped, demo / "data/chunk-000/file-001.parquet")
    assert [error.episode for error in check_dataset(Dataset(demo))] == [2], "another task than its metadata"


def test_large_videos_are_linked_and_small_ones_joined_up_to_a_size(
    part: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    size = (part / "videos/observation.images.wrist/chunk-000/file-000.mp4").stat().st_size
    monkeypatch.setattr(merging, "VIDEO_MB", 2.9e-6 * size)
    merge([part, part, part], joined := tmp_path / "joined")
    videos = [episode.place.video("wrist") for episode in Dataset(tmp_path / "joined").episodes]
    assert [file for file, _ in videos] == [0, 0, 1, 1, 2, 2]
    assert [first for _, first in videos[::2]] == [0, 0, 0]
    check_layout(tmp_path / "joined")
    monkeypatch.setattr(merging, "VIDEO_MB", 1.5e-6 * size)
    delete_episodes(joined, [0, 5])
    for one, other in zip(Dataset(part).episodes[::-1] * 2, Dataset(joined).episodes, strict=True):
        assert pictures_of(one, "color") == pictures_of(other, "color"), "a file of which a part is left is no link"
    merge([part], tmp_path / "linked")
    for one, other in zip(Dataset(part).episodes, Dataset(tmp_path / "linked").episodes, strict=True):
        assert one.files("wrist")["color"].samefile(other.files("wrist")["color"])


def test_many_files_are_joined_when_a_recorder_is_closed(
    part: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    demo = Path(shutil.copytree(part, tmp_path / "demo"))
    monkeypatch.setattr(merging, "LOOSE", 2)
    link = tmp_path / "link"
    link.symlink_to(demo)
    with mock_rig() as rig, Recorder(rig, link, fps=20) as recorder:
        record(recorder, 0.2)
    assert link.is_symlink()
    assert len(list(demo.glob("data/*/*"))) == 1
    assert check_layout(demo)["total_episodes"] == 3


def test_a_set_of_the_older_columns_is_read_and_not_merged_with_a_new_one(part: Path, tmp_path: Path) -> None:
    old = Path(shutil.copytree(part, tmp_path / "old"))
    make_old(old)
    for episode, source in zip(Dataset(old).episodes, Dataset(part).episodes, strict=True):
        assert np.array_equal(episode.columns["rig.setpoint"], source.columns["rig.setpoint"])
        assert episode.names("rig.setpoint") == source.names("rig.setpoint")
        assert episode.stamps.keys() == source.stamps.keys()
    assert not list(check_dataset(Dataset(old)))
    with pytest.raises(CommandError) as refused:
        merge([old, part], tmp_path / "both")
    assert refused.value.code == "other_dataset"
    for key in ("observation.setpoint", "rig.setpoint", "next.done"):
        assert key in str(refused.value)
    assert merge([old, old], tmp_path / "both") == 4, "but with its own kind"
    shutil.rmtree(old / "meta")
    repair(old)
    assert not list(check_dataset(Dataset(old)))


def make_old(root: Path) -> None:
    """Give a dataset the columns and the metadata of earlier versions."""

    def older(key: str) -> str:
        return key.replace("rig.", "observation.")

    new = ("source", "intervention", "next.done", "next.success")
    join_metadata(root)
    for path in [root / "meta/info.json", *root.glob("episodes/*.json")]:
        about = json.loads(path.read_text())
        about.pop("files", None)
        about["features"] = {older(key): each for key, each in about["features"].items() if key not in new}
        path.write_text(json.dumps(about))
    stats = json.loads((root / "meta/stats.json").read_text())
    (root / "meta/stats.json").write_text(json.dumps({older(k): v for k, v in stats.items() if k not in new}))
    for path in root.glob("data/*/*"):
        table = pq.read_table(path).drop(list(new))
        pq.write_table(table.rename_columns([older(name) for name in table.column_names]), path)
    for path in root.glob("meta/episodes/*/*"):  # one file; it was one for each episode
        table = pq.read_table(path)
        gone = [name for name in table.column_names if name.split("/")[1:2] and name.split("/")[1] in new]
        gone += ["success", "dropped", *(name for name in table.column_names if name.startswith("camera_"))]
        table = table.drop(gone)
        table = table.rename_columns([older(name) for name in table.column_names])
        for number in range(len(table)):
            row = table.slice(number, 1).to_pydict() | {"meta/episodes/file_index": [number]}
            pq.write_table(pa.table(row), path.with_name(f"file-{number:03d}.parquet"))
