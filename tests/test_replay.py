"""Drives as links: true ones, false ones, and invalid links."""

import struct
import zlib
from functools import cache

import pytest
from covering import covering
from own_tasks import Deliver, Switched

from lag_envs import cli, replay
from lag_envs.envs.unfused import Unfused
from lag_envs.leaderboard.drives import best_drives
from lag_envs.leaderboard.log import BoardError
from lag_envs.tasks import TASKS, incline, pivoted_bar

ID = pivoted_bar.Balance.id


def driven(task, seed=5, name=None, most=200):
    """Return a drive by bang-bang and then by idling, with its true return."""
    env = Unfused(task)
    env.reset(seed)
    total, keys, over = 0.0, [], False
    choices = task.formulas.choices
    while not over and len(keys) < most:
        i = len(keys) // 7
        key = tuple((i + j) % n for j, n in enumerate(choices)) or tuple(
            (-64, 64, 0, 3)[(i + j) % 4] for j in range(task.formulas.actions)
        )
        _, reward, terminated, truncated = env.step(replay.action_from_numbers(key, task))
        total, over = total + reward, terminated or truncated
        keys.append(key)
    return replay.Drive(name or task.id, seed, replay.pack(keys), total, env.program.digest)


@pytest.mark.parametrize("id", covering())
def test_what_was_driven_is_true(id):
    drive = driven(TASKS[id](), most=10_000)
    found = replay.replay(replay.write_link(drive, "https://example.org/board/x.html"))
    assert found.true and found.finished and found.total == drive.claimed
    assert found.score == pytest.approx(found.score)


@pytest.mark.parametrize("task", [Deliver, Switched])
def test_several_controls_choices_targets_and_kicks(task):
    drive = driven(task())
    found = replay.replay(drive, task())
    assert found.true and found.finished and found.score is None


def test_a_link_may_be_percent_encoded():
    link = replay.write_link(short())
    assert replay.read_link(link.replace("~", "%7E") + "%0A") == short()


def test_a_claim_in_its_last_bit_is_false():
    drive = driven(TASKS[ID]())
    (bits,) = struct.unpack(">q", struct.pack(">d", drive.claimed))
    (other,) = struct.unpack(">d", struct.pack(">q", bits + 1))
    found = replay.replay(replay.write_link(drive._replace(claimed=other)))
    assert not found.true and found.total == drive.claimed


def test_a_drive_may_stop_before_its_end():
    found = replay.replay(short())
    assert found.true and not found.finished and found.score is None


@cache
def short():
    return driven(TASKS[ID](), most=10)


def altered(field, value):
    link = replay.write_link(short())
    fields = link.removeprefix("#drive=").split("~")[:-1]
    fields[field] = value
    text = "~".join(fields)
    return f"#drive={text}~{zlib.crc32(text.encode()):08x}"


@pytest.mark.parametrize(
    "link, told",
    [
        ("", "not a link to a drive"),
        ("https://example.org/", "not a link to a drive"),
        ("#drive=", "not a link to a drive"),
        ("#drive=1~x", "has 2 fields, not 7"),
        (altered(0, "2"), "version '2'"),
        (altered(1, "PivotedBra-v0"), "did you mean PivotedBar"),
        (altered(2, str(2**64)), "below 2"),
        (altered(2, "-1"), "below 2"),
        (altered(2, "007"), "without leading zeros"),
        (altered(2, "\u0667"), "a whole number"),
        ("#drive=1~a\udcff~1~gA~3fe0000000000000~01234567~00000000", "checksum"),
        (altered(3, "é"), "base64url"),
        (altered(3, ""), "no step"),
        (altered(3, "gA"), "middle of a key"),
        (altered(3, "gICAgICAgAE"), "too long"),
        (altered(3, replay.pack([(65,)])), "between -64 and 64"),
        (altered(3, replay.pack([(64,)] * 3000)), "the episode ends after"),
        (altered(3, replay.pack([(0,)]) [:2] + "A"), "an empty run"),
        (altered(4, "12"), "16 hexadecimal"),
        (altered(4, "7ff8000000000000"), "a finite number, got nan"),
        (altered(4, "fff0000000000000"), "a finite number, got -inf"),
        (altered(5, "x"), "8 hexadecimal"),
        (altered(5, "00000000"), "another step"),
        (altered(1, "x" * 300_000), "characters; at most"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_link_is_told(link, told, capsys):
    with pytest.raises(replay.LinkError, match=told):
        replay.replay(link)
    assert cli.main(["replay", link]) == 2
    assert told in capsys.readouterr().err


def test_every_changed_character_is_noticed():
    link = replay.write_link(driven(TASKS[ID](), most=30))
    for i in range(len("#drive="), len(link)):
        with pytest.raises(replay.LinkError):
            replay.read_link(link[:i] + ("0" if link[i] != "0" else "1") + link[i + 1 :])
        with pytest.raises(replay.LinkError):
            replay.read_link(link[:i])


def test_what_is_no_drive_is_told():
    with pytest.raises(TypeError, match="takes a Drive or the text of a link, got 3"):
        replay.replay(3)


def test_the_command(capsys):
    drive = driven(TASKS[ID]())
    assert cli.main(["replay", replay.write_link(drive, "https://example.org/x.html")]) == 0
    said = capsys.readouterr().out
    assert repr(drive.claimed) in said and "score" in said and "true: every bit" in said
    assert cli.main(["replay", replay.write_link(drive._replace(claimed=1.0))]) == 1
    assert "FALSE: the link claims 1.0" in capsys.readouterr().out


def test_the_command_on_an_environment_of_ones_own(tmp_path, capsys):
    file = tmp_path / "mine.py"
    file.write_text(
        "from lag_envs.scenes import CartPole\nfrom lag_envs.tasks import Task\n\n\n"
        "class Push(Task):\n    id = 'Push-v0'\n    scene = CartPole\n    interval, steps = 0.02, 50\n"
        "    action = {'force': 10.0}\n    start = {'theta': 0.1}\n\n"
        "    def observe(self, after, target, xp):\n        return {'theta': after.theta}\n\n"
        "    def reward(self, before, after, control, target, dt, xp):\n        return xp.cos(after.theta)\n"
    )
    from lag_envs import own_files

    drive = driven(own_files.one(str(file))())
    assert cli.main(["replay", replay.write_link(drive), "--file", str(file)]) == 0
    assert "Push-v0, seed 5, 50 steps" in capsys.readouterr().out
    other = driven(TASKS[ID]())
    assert cli.main(["replay", replay.write_link(other), "--file", str(file)]) == 2
    assert f"the link is for {ID!r}, but {file} has 'Push-v0'" in capsys.readouterr().err


# --- the board's best drives --------------------------------------------------------------------------------


def test_best_drives_are_recomputed_and_sorted(tmp_path):
    assert best_drives(tmp_path) == {}
    made = [driven(TASKS[ID](), seed=seed) for seed in (1, 2, 3)]
    other = driven(TASKS[incline.Tilt.id](), most=10_000)
    links = [replay.write_link(drive, "https://example.org/x.html") for drive in (*made, other)]
    text = "# by hand\n\n" + "".join(f"{link} Ada {i}\n" for i, link in enumerate(links))
    (tmp_path / "drives.txt").write_text(text)
    found = best_drives(tmp_path)
    assert sorted(found) == sorted([ID, other.id])
    returns = [drive["return"] for drive in found[ID]]
    assert returns == sorted((drive.claimed for drive in made), reverse=True)
    assert all(drive["link"].startswith("#drive=1~") and drive["name"][:3] == "Ada" for drive in found[ID])


@pytest.mark.parametrize(
    "line, told",
    [
        ("{link}", "a link, a space and a name"),
        ("{link} " + "x" * 61, "at most 60"),
        ("{link} Ada\u202e", "a link, a space and a name"),
        ("nonsense Ada", "line 1: 'nonsense' is not a link"),
        ("{false} Ada", "line 1: the claim is false"),
        ("{short} Ada", "stops before its episode's end"),
        ("{link} Ada\n{link} Eve", "line 2: this drive is already listed"),
    ],
)
def test_what_is_wrong_with_a_line_is_told(tmp_path, line, told):
    drive = driven(TASKS[ID]())
    links = {
        "link": replay.write_link(drive),
        "false": replay.write_link(drive._replace(claimed=0.25)),
        "short": replay.write_link(driven(TASKS[ID](), most=10)),
    }
    (tmp_path / "drives.txt").write_text(line.format(**links))
    with pytest.raises(BoardError, match=told):
        best_drives(tmp_path)
