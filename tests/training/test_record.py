"""What a training leaves behind: whose checkpoint it is."""

from dataclasses import replace

import pytest

from rapid import checkpoint
from rapid.config import AdaptConfig
from rapid.errors import RapidError
from rapid.training.machinery.record import CHECKPOINT_FILE, Record

CONFIG = AdaptConfig(steps=20)


def test_a_setting_that_is_new_since_the_checkpoint_had_its_default(tmp_path):
    Record(tmp_path, {"config": CONFIG, "seed": 1}).checkpoint(lambda: {"done": 7}, now=True)
    path = tmp_path / CHECKPOINT_FILE
    content = checkpoint.load_state(path)
    del content["settings"]["config"]["mirror"], content["settings"]["config"]["ppo"]["clip"]
    checkpoint.save_state(path, content)
    assert Record(tmp_path, {"config": CONFIG, "seed": 1}).resume() == {"done": 7}
    others = (
        replace(CONFIG, mirror=True),
        replace(CONFIG, ppo=replace(CONFIG.ppo, clip=0.1)),
        replace(CONFIG, steps=9),
    )
    for other in others:
        with pytest.raises(RapidError, match=r"other settings \(config differ\)"):
            Record(tmp_path, {"config": other, "seed": 1}).resume()
    with pytest.raises(RapidError, match=r"other settings \(seed differ\)"):
        Record(tmp_path, {"config": CONFIG, "seed": 2}).resume()
