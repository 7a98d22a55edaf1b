"""Writing results: whole or not at all, and nothing lost by accident."""

import errno
import os

import numpy as np
import pytest

from unmix_plugin.errors import ConfigError, RunError
from unmix_plugin.formats.files import array_bytes, make_folder, refuse_to_overwrite, write_file


def test_a_file_is_written_into_a_folder_made_for_it(tmp_path):
    path = write_file(tmp_path / "a" / "b.npy", array_bytes(np.arange(3)))
    np.testing.assert_array_equal(np.load(path), [0, 1, 2])
    assert [file.name for file in path.parent.iterdir()] == ["b.npy"]


@pytest.mark.parametrize(
    ("number", "advice"),
    [(errno.ENOSPC, "No space left on device; make room"), (errno.EFBIG, r"File too large; .*ulimit -f")],
)
def test_a_full_disk_keeps_the_old_file_and_says_what_to_do(tmp_path, monkeypatch, number, advice):
    def full(*_args):
        raise OSError(number, os.strerror(number))

    path = write_file(tmp_path / "file", b"old")
    monkeypatch.setattr(os, "write", full)
    with pytest.raises(RunError, match=f"can't write .*file: {advice}"):
        write_file(path, b"new")
    assert path.read_bytes() == b"old"
    assert len(list(tmp_path.iterdir())) == 1


def test_existing_files_are_counted_and_refused_unless_overwriting_was_asked_for(tmp_path):
    paths = [tmp_path / name for name in "abc"]
    refuse_to_overwrite(paths, overwrite=False)
    for path in paths[1:]:
        path.write_bytes(b"")
    with pytest.raises(ConfigError, match=r"b and 1 more of its files exist already; give --overwrite"):
        refuse_to_overwrite(paths, overwrite=False)
    refuse_to_overwrite(paths, overwrite=True)


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(RunError, match="can't make the folder"):
        make_folder(tmp_path / "file" / "folder")
