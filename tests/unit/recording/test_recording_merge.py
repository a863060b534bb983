"""Merging of datasets, and a recorder that goes from one rig to another of the same configuration."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from errors_kit import raises_code
from recording_kit import check_layout, mock_rig, record

from hal.errors import CommandError, DatasetError
from hal.recording import Dataset, Recorder, merge, repair

RENUMBERED = {"episode_index", "index", "task_index"}


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
        for camera in source.cameras:
            for stream, file in source.files(camera).items():
                assert file.samefile(episode.files(camera)[stream]), "neither copied nor encoded again"
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
    merged.rename(tmp_path / ".merged.replaced")  # as if the program had been killed between two renames
    assert merge([merged, part], merged) == 6


def test_what_cannot_be_merged_is_refused(part: Path, tmp_path: Path) -> None:
    copy, out = tmp_path / "copy", tmp_path / "out"
    shutil.copytree(part, copy)
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
    (copy / "videos/observation.images.wrist/chunk-000/file-001.mp4").unlink()
    with pytest.raises(DatasetError) as damaged:
        merge([part, copy], out)
    assert damaged.value.episode == 1
    assert not out.exists()
