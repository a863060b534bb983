"""URDFs and meshes that make a library crash, or fail with an error of its own: each is one sentence that names it."""

from __future__ import annotations

import os
import random
import re
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from hal.config import load
from hal.errors import ConfigError
from hal.kinematics.mesh_files import check_mesh
from hal.kinematics.urdf import read_urdf

MUTATIONS = int(os.environ.get("HAL_FUZZ_COUNT", "300"))
"""Number of mutated URDFs and meshes; a longer run is asked for by the environment."""
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
ARM = """<robot name="arm">
  <link name="base"/>
  <link name="upper">
    <inertial><origin xyz="0 0 0.1"/><mass value="1"/>
      <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><mesh filename="part.obj" scale="1 1 1"/></geometry></visual>
    <collision><origin xyz="0 0 0.1" rpy="0 0 0"/><geometry><box size="0.1 0.1 0.2"/></geometry></collision>
  </link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.1"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="10" velocity="1"/></joint>
</robot>"""
COLLADA = """<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="9">0 0 0 1 0 0 0 1 0</float_array>
<technique_common><accessor source="#a" count="3" stride="3"/></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="1"><input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2</p></triangles>
</mesh></geometry></library_geometries></COLLADA>"""


def arm(folder: Path, urdf: str = ARM, mesh: str = TRIANGLE + "f 1 2 3\n") -> Path:
    (folder / "part.obj").write_text(mesh)
    (folder / "arm.urdf").write_text(urdf)
    return folder / "arm.urdf"


def test_an_arm_in_order(tmp_path: Path) -> None:
    assert set(read_urdf(arm(tmp_path)).joints) == {"turn"}


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("<robot", '\n\n<?xml version="1.0"?>\n<robot'),
        ('ixx="0.01"', 'ixx="-5.4e-20"'),
        ('scale="1 1 1"', 'scale="1 1 1 1"'),
        ("</joint>", "<drake:acceleration xyz='1'/></joint>"),
    ],
)
def test_what_other_readers_accept(tmp_path: Path, old: str, new: str) -> None:
    model = read_urdf(arm(tmp_path, ARM.replace(old, new, 1)))
    assert model.links["upper"].visuals[0].size == (1.0, 1.0, 1.0)


JOINT = '<joint name="{}" type="fixed"><parent link="{}"/><child link="{}"/></joint></robot>'


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("</robot>", '<link name="loose"/></robot>', "'base', 'loose' are no joint's child"),
        ("</robot>", JOINT.format("back", "upper", "base"), "is its own ancestor"),
        ("</robot>", JOINT.format("other", "base", "upper"), "'upper' is the child of two joints, 'turn' and 'other'"),
        ("</robot>", '<link name="base"/></robot>', "two links of one name"),
        ('<link name="base"/>', '<link name="base"/><link/>', "a <link> has no name"),
        ('type="revolute"', 'type="spherical"', "joint 'turn' has type 'spherical'"),
        ('axis xyz="0 0 1"', 'axis xyz="nan 0 1"', "joint 'turn': <axis xyz='nan 0 1'> must be finite"),
        ('axis xyz="0 0 1"', 'axis xyz="0 0 0"', "joint 'turn': <axis xyz='0 0 0'> is not a direction"),
        ('effort="10"', 'effort="-10"', "<limit effort='-10'> must be finite and not negative"),
        ('origin xyz="0 0 0.1"/>\n    <axis', 'origin xyz="0 0.1"/>\n    <axis', "must be 3 number(s)"),
        ('mass value="1"', 'mass value="inf"', "link 'upper': <mass value='inf'>"),
        ('box size="0.1 0.1 0.2"', 'box size="0.1 ${w} 0.2"', "is not a number"),
        ('<robot name="arm">', '<?xml version="1.0" encoding="klingon"?><robot name="arm">', "not valid XML"),
        ('<robot name="arm">', '<?xml version="1.0" encoding="utf-7"?><robot name="arm">', "not valid XML"),
    ],
)
def test_what_is_wrong_in_a_urdf_is_one_sentence(old: str, new: str, words: str, tmp_path: Path) -> None:
    assert old in ARM
    path = arm(tmp_path, ARM.replace(old, new))
    with pytest.raises(ValueError, match=re.escape(words)):
        read_urdf(path)
    with pytest.raises(ConfigError) as refused:
        load({"objects": [{"name": "it", "urdf": str(path)}]})
    assert [(problem.file, problem.code) for problem in refused.value.problems] == [(str(path), "bad_urdf")]


LINKS = "<robot><link name='a'/><link name='b'/><joint name='j' type='fixed'>{}</joint></robot>"


@pytest.mark.parametrize(
    ("urdf", "words"),
    [
        ("<robot name='x'><link name='a'></robot>", "is not valid XML"),
        ("<sdf/>", "<sdf>"),
        ("<robot/>", "has no links"),
        (LINKS.format("<parent link='a'/>"), "'j' has no parent or no child"),
        (LINKS.format("<parent link='a'/><child link='c'/>"), "'j' refers to link 'c'"),
        (LINKS.format("<parent link='a'/><child link='b'/><limit lower='low'/>"), "<limit lower='low'>"),
    ],
)
def test_files_that_are_not_a_urdf(tmp_path: Path, urdf: str, words: str) -> None:
    with pytest.raises(ValueError, match=re.escape(words)):
        read_urdf(arm(tmp_path, urdf))


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.obj", TRIANGLE + "f 1 2 99999999\n", "vertex index 99999999, but only 3"),
        ("a.obj", TRIANGLE + "f 1 2 -99999999\n", "vertex index -99999999, but only 3"),
        ("a.obj", TRIANGLE + "f 0 1 2\n", "vertex index 0"),
        ("a.obj", TRIANGLE + "f 1/7 2/8 3/9\n", "texture index 7, but only 0"),
        ("a.obj", TRIANGLE + "vn 0 0 1\nf 1//1 2//1 3//2\n", "normal index 2, but only 1"),
        ("a.obj", TRIANGLE + f"f 1 2 {'9' * 400}\n", "400 digits"),
        ("a.obj", "v nan 0 0\n" + TRIANGLE + "f 1 2 3\n", "not finite"),
        ("a.obj", "v one 0 0\n" + TRIANGLE + "f 1 2 3\n", "not a number"),
        ("a.stl", "", "truncated"),
        ("a.stl", b"\0" * 80 + struct.pack("<I", 1000) + b"\0" * 50, "truncated"),
        ("a.stl", b"\0" * 80 + struct.pack("<I", 1) + struct.pack("<12f", *[float("nan")] * 12) + b"\0\0", "finite"),
        ("a.dae", COLLADA.replace("0 1 2</p>", "0 1 99999999</p>"), "v index 99999999, but only 3"),
        ("a.dae", COLLADA.replace("0 1 2</p>", "0 1 -1</p>"), "v index -1"),
        ("a.dae", COLLADA[:300], "not valid XML"),
    ],
)
def test_what_is_wrong_in_a_mesh_names_its_file(name: str, content: str | bytes, words: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    path = arm(tmp_path, ARM.replace("part.obj", name))
    with pytest.raises(ConfigError) as caught:
        load({"objects": [{"name": "it", "urdf": str(path)}]})
    (problem,) = caught.value.problems
    assert problem.file == str(path)
    assert f"mesh {name}: " in problem.message
    assert words in problem.message


@pytest.mark.parametrize(
    ("name", "content"),
    [
        (
            "a.obj",
            "o part\n" + TRIANGLE + "vt 0 0\nvn 0 0 1\nf 1/1/1 2/1/1 3/1/1\nf -3//-1 -2//-1 -1//-1\n",
        ),
        ("a.stl", b"x" * 80 + struct.pack("<I", 1) + struct.pack("<12f", *range(12)) + b"\0\0"),
        (
            "a.stl",
            "solid s\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n",
        ),
        ("a.dae", COLLADA),
        ("a.ply", "not read here"),
    ],
)
def test_meshes_in_order(name: str, content: str | bytes, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    check_mesh(tmp_path / name)


def test_a_mesh_that_was_repaired_is_read_again(tmp_path: Path) -> None:
    path = arm(tmp_path, mesh=TRIANGLE + "f 1 2 9\n")
    with pytest.raises(ValueError, match="index 9"):
        read_urdf(path)
    read_urdf(arm(tmp_path))


def test_a_base_link_that_its_arm_moves(tmp_path: Path) -> None:
    arm(tmp_path)
    (tmp_path / "arm.yaml").write_text(
        "{urdf: arm.urdf, joints: [turn], base_link: upper, tcp: {link: upper}, home: [0], drivers: {sim: pybullet}, "
        "limits: {acceleration: 1, jerk: 10}}"
    )
    with pytest.raises(ConfigError) as caught:
        load({"robots": {"arm": {"model": str(tmp_path / "arm.yaml")}}})
    assert [problem.key for problem in caught.value.problems] == ["base_link"]


@pytest.mark.slow
def test_what_is_not_refused_does_not_end_the_simulator(tmp_path: Path) -> None:
    """Runs in a process of its own, which a crash would end."""
    pytest.importorskip("pybullet")
    done = subprocess.run(
        [sys.executable, __file__, str(tmp_path), str(MUTATIONS)],
        capture_output=True,
        text=True,
        timeout=60 + 0.5 * MUTATIONS,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-1000:] + done.stderr[-3000:]
    loaded, refused = map(int, done.stdout.split()[-2:])
    assert loaded + refused == MUTATIONS
    assert loaded > 0.05 * MUTATIONS
    assert refused > 0.3 * MUTATIONS


PIECES = [
    "nan",
    "-1",
    "0",
    "1e400",
    "",
    "0 0",
    "99999999",
    "-99999999",
    "upper",
    "base",
    "part.obj",
    ".",
    "<",
    "f ",
    "/",
]


def mutated(text: str, source: random.Random) -> str:
    """Return a text with some words or characters replaced, or a line doubled or removed."""
    for _ in range(source.randint(1, 3)):
        lines = text.split("\n")
        k = source.randrange(len(lines))
        words = [word for part in text.replace(">", ' "').split('"') for word in part.split()]
        kind = source.randrange(5)
        if kind == 0:
            lines.insert(k, lines[source.randrange(len(lines))])
            text = "\n".join(lines)
        elif kind == 1:
            text = "\n".join(lines[:k] + lines[k + 1 :])
        elif words:
            new = source.choice([*PIECES, source.choice(words)])
            k = max(0, text.find(source.choice(words), source.randrange(len(text))))
            text = text[:k] + text[k:].replace(source.choice(words), new, 1)
    return text


def fuzz(folder: Path, count: int) -> None:
    """Load ``count`` mutated arms as objects, and print how many a simulation took and how many were refused."""
    from hal.drivers.pybullet.world import PyBulletWorld
    from hal.specs import BodySpec, WorldSpec

    loaded = refused = 0
    upright = (0.0, 0.0, 0.0, 1.0)
    for seed in range(count):
        source = random.Random(seed)
        mesh = TRIANGLE + "vn 0 0 1\nf 1//1 2//1 3//1\n"
        whole = source.random() < 0.5
        path = arm(folder, ARM if whole else mutated(ARM, source), mutated(mesh, source) if whole else mesh)
        print(f"seed {seed}", file=sys.stderr, flush=True)
        body = BodySpec("it", (0.0, 0.0, 1.0), upright, "urdf", urdf=str(path))
        try:
            world = PyBulletWorld(WorldSpec("pybullet", 240.0, (0.0, 0.0, -9.81), (body,), ()))
        except ConfigError:
            refused += 1
            continue
        world.step()
        world.close()
        loaded += 1
    print(loaded, refused)


if __name__ == "__main__":
    fuzz(Path(sys.argv[1]), int(sys.argv[2]))
