"""Logs of boards that range by broadcasts: made here with separate clocks, and recorded ones."""

import functools
import json
import shutil
import tarfile

import numpy as np
import pytest

import calib
from tests import processes
from tests.errors import one_line
from tests.shared_data import shared
from tests.uwblink.test_from_arrays import PLACES, broadcasts
from uwblink import errors, load, raw_range
from uwblink.importers import import_file, read_source
from uwblink.importers.guess import guess_map

NAMES = [f"0x{tag:04X}" for tag in (0xE621, 0x9042, 0x853C, 0xBB1E)]


def printed(receptions, remembered=6):
    """Return the lines of a log: every board that hears a broadcast, and its sender, prints it with the list of its
    sender.

    `ts` of a listed frame is the time at which the sender of the list received it.
    """
    memory: dict[int, list[dict[str, object]]] = {k: [] for k in range(4)}
    lines, numbers = ["/dev/port1\tTrying to connect..."], dict.fromkeys(range(4), 90)
    for frame in np.unique(receptions.frame):
        rows = np.flatnonzero(receptions.frame == frame)
        sender, tx = int(receptions.sender[rows[0]]) - 10, int(receptions.tx[rows[0]])
        numbers[sender] += 1
        body = {"tx": {"addr": NAMES[sender], "sn": numbers[sender], "ts": tx}, "rx": memory[sender][:remembered]}
        for board in [sender, *(receptions.listener[rows] - 10).tolist()]:
            head = {"type": "tx"} if board == sender else {"type": "rx", "clock_ratio_offset": 2e-6, "rssi": -78}
            lines += [f"/dev/port{board}\t {json.dumps(head | body)}", ""]
        for row in rows:
            heard = {"addr": NAMES[sender], "sn": numbers[sender], "ts": int(receptions.rx[row])}
            memory[int(receptions.listener[row]) - 10].insert(0, heard)
    lines[40] = lines[40][len(lines[40]) // 2 :]  # a board started in the middle of a line
    return "\n".join(lines) + "\n"


COLUMNS = ("sender", "listener", "tx", "rx")


def numbers(found):
    """Return the index of each tag's name in the list of names."""
    return {tag.tag: NAMES.index(tag.body) for tag in found.tags}


def distances(found):
    own = np.vectorize(numbers(found).get)
    return np.linalg.norm(PLACES[own(found.exchanges.initiator)] - PLACES[own(found.exchanges.target)], axis=1)


def imported(tmp_path, text, change=lambda whole: whole):
    """Import the text of a log by its guess, with ticks as the answer, after changes."""
    (tmp_path / "a.log").write_text(text)
    whole = guess_map(tmp_path / "a.log").text.replace('"?"', '"ticks"')
    (tmp_path / "m.toml").write_text(change(whole))
    return read_source(tmp_path / "a.log", importer="csv", map_file=tmp_path / "m.toml")


@pytest.mark.slow
def test_every_reception_comes_from_the_lists_and_exchanges_from_receptions(tmp_path):
    planted = broadcasts(rounds=1000, slot_s=0.02)  # 80 s, so that counters of 40 bits wrap
    (tmp_path / "swarm.log").write_text(printed(planted))
    said = processes.succeed("uwblink", "import", "guess", "swarm.log", "-o", "m.toml", cwd=tmp_path).stdout
    assert "check it" in said
    assert 'layout = "broadcasts"' in (tmp_path / "m.toml").read_text()
    processes.succeed("uwblink", "import", "csv", "swarm.log", "--map", "m.toml", "-o", "s.uwb", cwd=tmp_path)
    found = load(tmp_path / "s.uwb")
    named = numbers(found)
    assert sorted(named.values()) == [0, 1, 2, 3]
    got = {
        tuple(named[n] + 10 for n in row[:2]) + row[2:]
        for row in zip(*(found.receptions[n].tolist() for n in COLUMNS), strict=True)
    }
    sent = {*zip(*(getattr(planted, n).tolist() for n in COLUMNS), strict=True)}
    # All but those of the last broadcasts, which no later one lists.
    assert got <= sent
    assert len(sent - got) <= 3 * 4
    assert np.all(np.diff(found.receptions["frame"]) >= 0)
    assert np.abs(raw_range(found.exchanges) - distances(found)).max() < 0.01
    assert 6 * 900 < len(found.exchanges) < len(found.overheard["time_ns"])


def test_restarted_frame_numbers_are_other_frames(tmp_path):
    first, second = broadcasts(rounds=60), broadcasts(rounds=60, slot_s=0.007)
    found = imported(tmp_path, printed(first) + printed(second))
    assert len(found.exchanges) > 6 * 2 * 50
    assert np.abs(raw_range(found.exchanges) - distances(found)).max() < 0.01


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda _: 'line = "{json}"\neach = "rx"\nlayout = "broadcasts"\n', "column"),
        (lambda _: 'line = "{json}"\neach = "nothing"\n', "nothing"),
        (lambda whole: whole.replace('stamps = "ticks"', 'stamps = "ns"'), "units.stamps"),
    ],
)
def test_maps_that_cannot_be_are_refused_with_the_key(tmp_path, change, said):
    with pytest.raises(errors.ImportTableError, match=one_line(said)):
        imported(tmp_path, printed(broadcasts(rounds=30)), change)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Import a recorded log by its first number, once; return the path."""
    folder = tmp_path_factory.mktemp("swarm")
    with tarfile.open(shared("swarm_broadcast_logs.tar.xz")) as archive:
        archive.extractall(folder, filter="data")

    @functools.cache
    def of_run(run):
        (log,) = folder.rglob(f"{run}-*.log")
        (folder / "m.toml").write_text(guess_map(log).text)
        import_file(log, folder / f"{run}.uwb", importer="csv", map_file=folder / "m.toml")
        return folder / f"{run}.uwb"

    return of_run


def test_recorded_boards_give_the_ranges_of_their_description(recorded):
    """Medians of a separate program (README of the data folder), from stamps of 40 bits over 20 s."""
    found = load(recorded(90))
    assert len(found.receptions["rx"]) == 1098
    named = {tag.tag: tag.body.removeprefix("0x") for tag in found.tags}
    known = {"853C-9042": 0.53, "853C-BB1E": 0.60, "853C-E621": 2.09, "9042-BB1E": -0.87, "9042-E621": 0.67}
    for pair, range_m in (known | {"BB1E-E621": 0.70}).items():
        ends = [k for k in named if named[k] in pair]
        e = found.exchanges
        ours = e.range_m[np.isin(e.initiator, ends) & np.isin(e.target, ends)]
        assert len(ours) > 80
        # They are rounded to a centimetre; a rate from later frames alone would cause 5 cm.
        assert np.median(ours) == pytest.approx(range_m, abs=0.011)
        assert ours.std() < 0.04


def test_lossy_logs_have_no_wrong_ranges(recorded):
    """Seven boards stand still, and one in forty of their stamps is wrong by up to 110 m."""
    e = load(recorded(70)).exchanges
    assert len(e) > 0.96 * 496, "as many as there are with every stamp"
    key = np.sort(np.column_stack([e.initiator, e.target]), axis=1)
    pairs = np.unique(key, axis=0)
    # 0x0E5F heard 0xCDA3 nine times, four or five of them wrong.
    assert len(pairs) == 18
    for pair in pairs:
        ranges = raw_range(e)[(key == pair).all(axis=1)]
        assert len(ranges) > 5
        assert np.abs(ranges - np.median(ranges)).max() < 0.7
    # Frames in the log are 76 ms apart, by all clocks that stamped two of them.
    assert np.ptp(e.time_ns) * 1e-9 == pytest.approx(28.5, abs=1)


@pytest.mark.parametrize("run", [90, pytest.param(110, marks=pytest.mark.slow)])
@pytest.mark.parametrize("first", [0, 1])
def test_halves_of_a_run_agree_within_their_intervals(recorded, run, first):
    """The constants of both halves contain the unknown distances, which cancel.

    In run 110 a board warms up: by the rate of later frames alone, its pairs would drift by 12 to 19 cm.
    """
    e = load(recorded(run)).exchanges
    later = e.time_ns >= np.median(e.time_ns)
    halves = [
        calib.Ranges.from_arrays(
            raw_range(e)[h], initiator=e.initiator[h], target=e.target[h], time_ns=e.time_ns[h], truth_m=2.0
        )
        for h in (~later, later)
    ]
    fitted = calib.fit(halves[first], calib.FitSettings(constants="pair", delays_only=True, between_m=0.0))
    stage = calib.evaluate(halves[1 - first], fitted.calibration).to_dict()["overall"]
    assert abs(stage["full"]["median_m"]) < 0.02
    # 95 % of 270 ranges with four standard errors, doubled because errors persist.
    assert stage["inside_95"] > 0.89


@pytest.mark.parametrize(
    ("run", "use"),
    [
        pytest.param(90, "exchanges", marks=pytest.mark.slow),
        pytest.param(90, "receptions", marks=pytest.mark.slow),
        (70, "exchanges"),
    ],
)
def test_invented_geometry_is_refused(recorded, tmp_path, run, use):
    shutil.copy(recorded(run), tmp_path / "q.uwb")
    (tmp_path / "grid.toml").write_text(
        "".join(f"[[anchors]]\nid = {k + 1}\nposition_m = [{k % 2}, {k // 2}, 1.0]\n" for k in range(7))
    )
    processes.succeed("uwblink", "poses", "q.uwb", "--tags", "grid.toml", cwd=tmp_path)
    answer = json.loads(processes.succeed("calib", "doctor", "q.uwb", "--json", cwd=tmp_path).stdout)
    assert answer["findings"][0]["fault"] == "pairs that do not close"
    processes.refuse(
        *("calib", "fit", "q.uwb", "-o", "c.json", "--delays-only", "--use", use),
        cwd=tmp_path,
        naming=["q.uwb", "% of the ranges", "pair 1-4 or pair 2-3" if run == 90 else "pair"],
        status=1,
    )
    assert not (tmp_path / "c.json").exists()
