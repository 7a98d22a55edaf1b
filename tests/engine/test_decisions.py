import json

from unmix_plugin.engine.decisions import UNDECIDED, Decision, decision_table

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
