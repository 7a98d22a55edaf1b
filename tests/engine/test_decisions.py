import json
from dataclasses import dataclass, field

from unmix_plugin.engine.decisions import UNDECIDED, Decision, decision_table, settled_settings

WORLD = Decision("world", "bounded", {"behind the box": 0.0213, "pixels": 144}, "more behind", "--world")
MASK = Decision("mask", UNDECIDED, {"agree": True})


def test_a_table_tells_outcome_evidence_what_would_refute_it_and_the_flag():
    lines = decision_table([WORLD, MASK])
    assert lines == [
        "world  bounded",
        "       because  behind the box 0.0213, pixels 144",
        "       against  more behind",
        "       change   --world",
        "mask   undecided",
        "       because  agree yes",
    ]


def test_a_decision_is_kept_in_records():
    assert json.loads(json.dumps(WORLD.to_json()))["evidence"] == {"behind the box": 0.0213, "pixels": 144}
    assert MASK.is_undecided
    assert not WORLD.is_undecided


@dataclass(frozen=True)
class Inner:
    rays: int | str = "auto"
    kept: str = "auto"


@dataclass(frozen=True)
class Outer:
    light_kind: str = "auto"
    named: str = "fixed"
    lamp: tuple[float, ...] | str = "auto"
    inner: Inner = field(default_factory=Inner)


def test_settings_that_were_auto_are_decisions_with_their_flags():
    after = Outer("camera", "fixed", (0.1, 0.2, 0.3, 0.4), Inner(512, "auto"))
    found = {one.flag: one.outcome for one in settled_settings(Outer(), after, "pipeline.model")}
    assert found == {
        "--pipeline.model.light-kind": "camera",
        "--pipeline.model.lamp": "0.1, 0.2, 0.3, ... (4)",
        "--pipeline.model.inner.rays": "512",
    }
