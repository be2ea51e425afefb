"""Files that survive kills and full disks. Kills at every step of a board are in test_board_log.py."""

import argparse
import errno
import os
import stat
from pathlib import Path

import pytest

from lag_envs import store
from lag_envs.options import new_file, new_picture


@pytest.mark.parametrize("sync", [False, True])
def test_written_whole_with_its_folder(tmp_path, sync):
    file = tmp_path / "new" / "file"
    store.write_file(file, "ä", sync=sync)
    store.write_file(file, b"second", sync=sync)
    assert file.read_bytes() == b"second" and os.listdir(file.parent) == ["file"]


@pytest.mark.parametrize("place", [(Path, "write_bytes"), (os, "replace")])
def test_a_full_disk_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, place):
    file = tmp_path / "file"
    store.write_file(file, "old")

    def full(*args):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(*place, full)
    with pytest.raises(OSError, match="No space left") as refused:
        store.write_file(file, "new")
    assert refused.value.filename == str(file)
    assert file.read_text() == "old" and os.listdir(tmp_path) == ["file"]


def test_a_link_stays_and_what_it_leads_to_is_written(tmp_path):
    (tmp_path / "link").symlink_to("there/file")
    for text in ("first", "second"):
        store.write_file(tmp_path / "link", text)
        assert (tmp_path / "link").is_symlink() and (tmp_path / "there" / "file").read_text() == text
    assert os.listdir(tmp_path / "there") == ["file"]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes in the file system")
def test_pipes_and_devices_are_written_to_and_stay(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        store.write_file(pipe, "text")
        assert os.read(reader, 10) == b"text" and stat.S_ISFIFO(pipe.stat().st_mode)
    finally:
        os.close(reader)
    assert os.listdir(tmp_path) == ["pipe"]
    assert new_file(str(pipe)) == pipe and new_file(os.devnull) == Path(os.devnull)


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs Linux's /proc")
def test_a_folder_that_takes_no_files_is_noticed_at_once(tmp_path):
    with pytest.raises(argparse.ArgumentTypeError, match="/proc is not a writable folder"):
        new_file("/proc/x.json")
    assert new_file(str(tmp_path / "a" / "b")) == tmp_path / "a" / "b" and os.listdir(tmp_path) == []


@pytest.mark.parametrize("name", ["", "long" * 100])
def test_errors_name_the_file_that_was_asked_for(tmp_path, name):
    for write in (lambda path: store.write_file(path, ""), lambda path: store.append(path, {})):
        with pytest.raises(OSError) as refused:
            write(tmp_path / name)
        assert refused.value.filename == str(tmp_path / name)


def test_a_picture_is_known_by_its_ending_in_any_case(tmp_path):
    assert new_picture(str(tmp_path / "a.PNG")) == tmp_path / "a.PNG"
    with pytest.raises(argparse.ArgumentTypeError, match=r"ends with \.png, \.svg, \.pdf, got 'a\.gif'"):
        new_picture("a.gif")


def test_rows_after_a_kill_in_the_middle_of_one(tmp_path):
    file = tmp_path / "rows.jsonl"
    for number in range(3):
        store.append(file, {"number": number})
    file.write_bytes(file.read_bytes()[:-3] + b"")
    store.append(file, {"number": 3})
    assert [row["number"] for row in store.rows(file)] == [0, 1, 3]
    with pytest.raises(ValueError):
        store.append(file, {"number": float("nan")})
    assert len(list(store.rows(file))) == 3
    assert list(store.rows(tmp_path / "none")) == []
