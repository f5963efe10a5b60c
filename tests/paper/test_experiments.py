"""Each of the paper's experiments has a config and a picture."""

import re
from pathlib import Path

from ddrecon.scene_file.build import load_scene

ROOT = Path(__file__).parents[2]
CONFIGS = {config.stem: config for config in sorted((ROOT / "configs" / "paper").glob("*.yaml"))}


def test_every_experiment_has_a_config_and_a_picture():
    pictures = re.findall(
        r"\]\((pictures/paper/.*?)\)", (ROOT / "docs" / "experiments.md").read_text()
    )
    assert set(CONFIGS) <= {Path(picture).stem for picture in pictures}
    assert {int(name[3:5]) for name in CONFIGS} == {6, 7, 8, 9, 10, 12, 13, 14}
    assert load_scene(CONFIGS["fig08"]).views
    assert max((ROOT / "docs" / picture).stat().st_size for picture in pictures) < 150_000
