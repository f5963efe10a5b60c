"""What `ddrecon export` writes and says."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

from click.testing import Result
from small_scene import contents

Run = Callable[..., Result]
Refuse = Callable[..., list[str]]


def test_a_scene_becomes_xml_and_a_volume(succeed: Run) -> None:
    before = set(contents(Path()))
    result = succeed("export", "scene.yaml", "-o", "smoke.xml")
    assert set(contents(Path())) - before == {"smoke.xml", "smoke.sigma_t.vol"}
    assert result.stdout == "written: smoke.xml, smoke.sigma_t.vol\n"
    root = ElementTree.parse("smoke.xml").getroot()
    assert [sensor.attrib["id"] for sensor in root.iter("sensor")] == ["sensor_0", "sensor_1"]
    assert {emitter.attrib["type"] for emitter in root.iter("emitter")} == {"directional", "constant"}


def test_overwrite(succeed: Run, refuse: Refuse) -> None:
    succeed("export", "scene.yaml", "-o", "smoke.xml")
    (line,) = refuse(2, "export", "scene.yaml", "-o", "smoke.xml", "-D", "volume.g=0")
    assert line == "smoke.xml, smoke.sigma_t.vol: already there; choose another name, or say --overwrite"
    first = Path("smoke.xml").read_bytes()
    succeed("export", "scene.yaml", "-o", "smoke.xml", "--overwrite", "-D", "volume.g=0")
    assert Path("smoke.xml").read_bytes() != first


def test_only_xml(refuse: Refuse) -> None:
    assert refuse(2, "export", "scene.yaml", "-o", "smoke.obj")[-1] == "Error: -o smoke.obj: a scene for Mitsuba is an .xml file"


def test_no_folder(refuse: Refuse, folder: Path) -> None:
    assert refuse(2, "export", "scene.yaml", "-o", "none/smoke.xml") == ["none/smoke.xml: there is no folder none"]
