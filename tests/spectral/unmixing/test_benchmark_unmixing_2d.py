import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.io import savemat

from tests.factories.mixtures import seeded, smooth_endmembers

SCRIPT = Path(__file__).parents[3] / "benchmarks" / "unmixing_2d.py"


EACH = """
import contextlib, io, json, runpy, sys
script, ended = sys.argv[1], []
sys.path.insert(0, script.rpartition("/")[0])
for arguments in json.loads(sys.argv[2]):
    out, err, code, sys.argv = io.StringIO(), io.StringIO(), 0, [script, *arguments]
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            runpy.run_path(script, run_name="__main__")
        except SystemExit as stop:
            code = stop.code
    ended.append((code, out.getvalue(), err.getvalue()))
print(json.dumps(ended))
"""
"""Runs the script once for each list of arguments, in one process, which imports everything once."""
SOUND = ("plain.mat", "turned.mat")
WORDS = ("--endmembers", "3", "--seeds", "2", "--json", "--rows", "pairs, NNLS", "VCA, FCLS")
BAD = {
    ("text.mat",): "can't be read as a .mat file",
    ("no_truth.mat",): "has no 'A'; found Y",
    ("short.mat",): "expected Y (bands, pixels)",
    ("plain.mat", "--rows", "magic"): "no method is called 'magic'",
}


@pytest.fixture(scope="module")
def ended(tmp_path_factory):
    """Exit code, output and errors for each sound file, then for each bad call."""
    folder = tmp_path_factory.mktemp("images")
    materials = smooth_endmembers(3, 12).numpy()
    shares = torch.rand(300, 3, generator=seeded(), dtype=torch.float64).numpy() ** 4
    shares = shares / shares.sum(axis=1, keepdims=True)
    # As MATLAB users store them, in units of a thousand.
    image = {"Y": 1000 * (shares @ materials).T, "A": shares.T, "M": materials.T}
    savemat(folder / "plain.mat", image)
    savemat(folder / "turned.mat", {key: image[key].T for key in image})
    savemat(folder / "no_truth.mat", {"Y": image["Y"]})
    savemat(folder / "short.mat", image | {"A": image["A"][:, :-1]})
    (folder / "text.mat").write_text("no matrix")
    calls = [(name, *WORDS) for name in SOUND] + list(BAD)
    words = json.dumps([[str(folder / name), *more] for name, *more in calls])
    each = [sys.executable, "-c", EACH, str(SCRIPT), words]
    return json.loads(subprocess.run(each, capture_output=True, text=True, check=True).stdout)


def test_medians_and_spreads_are_printed_as_json_whatever_is_transposed(ended):
    assert [code for code, _, _ in ended[:2]] == [0, 0], ended
    reports = [json.loads(out) for _, out, _ in ended[:2]]
    assert reports[0]["methods"] == reports[1]["methods"]
    assert set(reports[0]["methods"]) == {"pairs, NNLS", "VCA, FCLS"}
    for figures in reports[0]["methods"].values():
        for found in (figures["abundance_rmse"], figures["endmember_angle"]):
            values = found["values"]
            figured = (np.median(values), max(values) - min(values), np.std(values))
            assert (found["median"], found["spread"], found["standard_deviation"]) == pytest.approx(figured)
    assert reports[0]["methods"]["VCA, FCLS"]["abundance_rmse"]["median"] < 0.1


def test_bad_input_is_one_message_and_exit_code_2(ended):
    for message, (code, _, errors) in zip(BAD.values(), ended[2:], strict=True):
        assert code == 2
        assert message in errors
        assert errors.count("\n") == 1
