"""Mistakes of users and faulty files, with all commands: one line, the right status, no output.

`{name}` in a line is a file of the fixture `seeds`; `own.*` is a file with the text of the row, in the working folder.
"""

import gzip
import json
import os
import pty
from dataclasses import replace
from pathlib import Path

import duckdb
import numpy as np
import pytest

import calib
import uwblink
import uwbsim
from tests.boards import bench_scenario, record_bench, served
from tests.processes import refuse, run, succeed
from tests.shared_data import ROOT
from uwblink.boards.ports import Terminal

NOISELESS = (ROOT / "scenarios" / "noiseless.toml").read_text()
BENCH = ROOT / "scenarios" / "two_boards_on_a_bench" / "bench.toml"
HEADER = "time_s,from_id,to_id,tx1,rx1,tx2,rx2"
GOOD = "0.0,1,2,100,200,300,500"
COUNT = 900
NO_UTF8 = os.fsdecode(b"no\xff")
DEEP = "a = " + "[" * 5000 + "]" * 5000
CURVE = {"knots": [0.0] * 4 + [2.0] * 4, "coeffs": [0.1] * 4, "degree": 3}
PUBLISHED = {"delays_ns": {"1": 0.1, "2": 1e12}, "bias_spline_m": CURVE, "std_spline_m": CURVE}


def changed(path, poses=None, tags=None, rows=slice(None), anchors=False, **columns):
    """Save the small flight of `calib sample` with other columns of its exchanges, poses or tags."""
    flight = calib.sample_flight(COUNT, anchors=anchors)
    exchanges = replace(flight.exchanges, **columns)[rows]
    poses, tags = flight.poses if poses is None else poses, flight.tags if tags is None else tags
    uwblink.Contents(exchanges=exchanges, poses=poses, tags=tags).save(path)
    return path


@pytest.fixture(scope="module")
def seeds(tmp_path_factory):
    folder = tmp_path_factory.mktemp("seeds")
    whole = changed(folder / "f.uwb").read_bytes()
    calib.fit(folder / "f.uwb").calibration.save(folder / "c.json")
    with duckdb.connect(str(folder / "other.uwb")) as db:
        db.execute("CREATE TABLE planets (name VARCHAR)")
    broken = gzip.compress((HEADER + "\n" + (GOOD + "\n") * 5000).encode(), mtime=0)
    ranges = "time_s,from_id,to_id,range_m\n0.0,1,2,3.0\n"
    for name, data in {
        "cut.uwb": whole[: len(whole) // 2],
        "again.uwb": whole,
        f"{NO_UTF8}.uwb": whole,
        "t.csv.gz": broken[:40] + broken[60:80] * 100 + broken[40:],
        "r.csv": ranges.encode(),
        f"{NO_UTF8}.csv": ranges.encode(),
        "wide.csv": ranges.encode("utf-16"),
        "zeros.csv": bytes(3000),
        "log.toml": b'line = "{range_m} m"\n[constants]\nfrom_id = 1\nto_id = 2\n',
        "poses.csv": b"time_s,body,x,y,z,qx,qy,qz,qw\n0.0,robot1,0,0,0,0,0,0,1\n",
    }.items():
        (folder / name).write_bytes(data)
    for name in ("p.json", "p.uwb", "p.csv", "p.toml", "p.mcap"):
        os.mkfifo(folder / name)
    (folder / "device.uwb").symlink_to("/dev/zero")
    return folder


def listed(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


def refused(seeds, folder, line, naming, text="", status=2, **names):
    """Run a line in a folder in which nothing may change except the row's own file, which is written before."""
    names |= {path.name.replace(".", "_"): path for path in seeds.iterdir()} | {"here": folder, "long": "a" * 5000}
    words = [word.format(**names, bench=BENCH, no=NO_UTF8) if "{" in word else word for word in line.split()]
    for name in ("mine", "mine.html", "mine.pdf"):
        (folder / name).write_text("mine")
    for own in {word for word in words if word.startswith("own.")}:
        (folder / own).write_text(text)
    before = listed(folder), listed(seeds)
    told = refuse(*words, cwd=folder, naming=naming, status=status)
    assert (listed(folder), listed(seeds)) == before
    return told


SCENARIOS = [
    ("rate_hz = 160.0", "rate_hz = -1.0", ["ranging.rate_hz", "-1.0", "greater than 0"]),
    ("rate_hz = 160.0", "rate_hz = 9000.0", ["ranging.rate_hz", "at most"]),
    ("rate_hz = 160.0", "rate_hertz = 1.0", ["ranging.rate_hertz", "unknown key", "rate_hz"]),
    ("rate_hz = 160.0", "rate_hz = inf", ["ranging.rate_hz", "inf"]),
    ("duration_s = 60.0", "duration_s = 0", ["run.duration_s", "greater than 0"]),
    ("id = 2\n", "id = 1\n", ["tags[1].id", "second 1"]),
    ('id = 2\nbody = "ifo001"', 'id = 2\nbody = "ifo9"', ["tags[1].body", "ifo9", "ifo001"]),
    ('protocol = "ds"', 'protocol = "tdoa"', ["ranging.protocol", "tdoa", "ds-alt"]),
    ('antenna = "dipole"', 'antenna = "yagi"', ["radio.antenna", "yagi", "isotropic"]),
    ("[run]", "[scenario", ["not valid TOML", "line"]),
    ("lever_arm_m", "lever_arm", ["lever_arm"]),
]
TABLES = [
    ("", ["empty"]),
    (HEADER + "\n", ["no rows"]),
    (HEADER.replace(",tx2", "") + "\n0,1,2,1,2,3\n", ["'tx2'", "missing", "--map"]),
    (HEADER + "\n" + GOOD + "\n0.1,1,2,100,abc,300,500\n", ["row 3", "'rx1'", "'abc'"]),
    (HEADER + "\n0.1,1,2,100,nan,300,500\n", ["row 2", "'rx1'", "'nan'"]),
    (HEADER + "\n0.1,1,2,100,,300,500\n", ["row 2", "'rx1'"]),
    (HEADER + "\n0.1,1,2,100,4294967296,300,500\n", ["row 2", "'rx1'", "4294967295"]),
    (HEADER + "\n0.1,1,2,100,1.5,300,500\n", ["row 2", "'rx1'", "whole number"]),
    (HEADER + "\n0.1,1,1,100,200,300,500\n", ["row 2", "'to_id'", "from_id"]),
    (HEADER + "\n0.1,1,2,100,200,300\n", ["row 2", "'rx2'", "''"]),
    (HEADER + ",tx1\n" + GOOD + ",1\n", ["two columns", "tx1"]),
]
GROUPS = [
    ("groups", ["not valid TOML"]),
    ("x = 1", ["expected one table [groups]"]),
    ("[groups]\na = 1", ["a:", "list of tag ids"]),
    ("[groups]\na = [1, 2]\nb = [2]", ["tag 2", "'a'", "'b'"]),
    ("[groups]\na = [1, 2]", ["tag 3", "not in any group"]),
    ("[groups]\na = [1]\n[group]\nb = [2]\n", ["own.toml", "groups"]),
]
WORDS = [
    ("uwbsim run no.toml -o o.uwb", ["no.toml", "no such"]),
    ("uwbsim run {here} -o o.uwb", ["directory"]),
    ("uwbsim run noiseless -o o.uwb --set ranging.rate", ["ranging.rate"]),
    ("uwbsim run noiseless -o no/x.uwb", ["does not exist"]),
    ("uwbsim run noiseless -o mine", ["mine", "--force"]),
    ("uwblink show {long}", ["File name too long"]),
    ("calib fit {f_uwb} -o {long}", ["File name too long"]),
    ("calib fit {f_uwb} -o mine", ["mine", "--force"]),
    ("calib fit {f_uwb} -o c.json --loss tukey", ["--loss", "tukey"]),
    ("calib fit {f_uwb} -o c.json --scale -1", ["--scale", "-1"]),
    ("calib fit {f_uwb} -o c.json --scale 1", ["--scale", "mixture"]),
    ("calib fit {f_uwb} -o c.json --lift up", ["--lift", "up"]),
    ("calib fit {f_uwb} -o c.json --fix 1", ["--fix", "'1'", "TAG=NS"]),
    ("calib fit {f_uwb} -o c.json --fold pair", ["--fold", "pair", "--hold-out"]),
    ("uwbsim run icra2023/train -o o.uwb --set tags.6.body=ifo001", ["tags.6.body", "0 to 5", "id 6 has index 5"]),
    ("uwblink import csv {wide_csv} -o o.uwb", ["wide.csv", "UTF-16", "UTF-8"]),
    ("uwblink import guess {f_uwb}", ["f.uwb", "is a recording already"]),
    ("calib fit {f_uwb} -o o.json --delays-only --delays-from {c_json}", ["--delays-from: it has the delays of all"]),
    ("calib fit {f_uwb} -o o.json --delays-only --fix 1=0 --fix 2=0 --fix 3=0", ["--fix: all delays are known"]),
    ("uwblink import guess {wide_csv}", ["wide.csv", "UTF-16", "UTF-8"]),
    ("uwblink import csv {wide_csv} --map {log_toml} -o o.uwb", ["wide.csv", "UTF-16", "UTF-8"]),
    ("calib apply {f_uwb} -c {c_json} -o mine", ["mine", "--force"]),
    ("calib evaluate {f_uwb} -c {c_json} --report mine.html", ["mine.html", "--force"]),
    ("calib report {f_uwb} -o r.html --pdf mine.pdf", ["mine.pdf", "--force"]),
    ("calib report {f_uwb} -o r.html --figures mine", ["mine", "is a file"]),
    ("calib report {f_uwb} -o r.html --figures no/figures", ["no", "does not exist"]),
    ("calib report {f_uwb} -o r.html --loss mixture --sequential", ["--sequential"]),
    ("uwbsim twin {f_uwb} -c {c_json} -o mine.toml", ["mine.html", "already exists"]),
    ("uwbsim twin {f_uwb} -c {c_json} -o t.txt", ["found .txt"]),
    ("uwblink export {f_uwb} --to xls -o out", ["--to", "xls", "csv, parquet, tum, mcap, rosbag2"]),
    ("uwblink export no.uwb --to csv -o out", ["no such recording"]),
    ("uwblink export {f_uwb} --to csv -o no/out", ["does not exist"]),
    ("uwblink export {f_uwb} --to csv -o mine", ["mine", "already exists"]),
    ("calib report no.uwb -o r.html", ["no.uwb", "no such"]),
    ("calib export {c_json} --to csv -o no/out.csv", ["no"]),
    ("uwblink import csv {t_csv_gz} -o o.uwb", ["t.csv.gz", "gzip"]),
    ("uwblink import csv {f_uwb} -o o.uwb", ["f.uwb", "not a text file"]),
    ("uwblink poses {f_uwb} --from {zeros_csv}", ["zeros.csv", "not a text file"]),
    ("uwblink poses {f_uwb} --from {wide_csv}", ["wide.csv", "UTF-16", "UTF-8"]),
    # Only recordings have this ending.
    ("uwblink import {r_csv} -o o.uwb", ["r.csv", "import guess"]),
    ("uwblink import guess {r_csv} -o o.uwb", ["o.uwb", ".uwb is the ending of recordings"]),
    ("calib fit {f_uwb} -o o.uwb", ["o.uwb", ".uwb is the ending of recordings"]),
    ("calib apply {f_uwb} -c {c_json} --to csv -o o.uwb", ["o.uwb", ".uwb is the ending of recordings"]),
    ("calib localize {f_uwb} -c {c_json} --tum o.uwb", ["o.uwb", ".uwb is the ending of recordings"]),
    ("uwbsim compare noiseless -o o.uwb", ["o.uwb", ".uwb is the ending of recordings"]),
    # A recording that is given twice, also under another name, would count as twice the evidence.
    ("calib fit {f_uwb} {f_uwb} -o o.json", ["f.uwb"]),
    ("calib evaluate {again_uwb} {f_uwb} -c {c_json}", ["f.uwb"]),
    # A recording is not written under the name of a table.
    ("calib apply {f_uwb} -c {c_json} -o c.csv", ["c.csv", "c.uwb"]),
    ("calib sample -o c.parquet", ["c.parquet", "c.uwb"]),
    ("uwbsim run noiseless -o c.mcap", ["c.mcap", "c.uwb"]),
    ("uwblink import csv {r_csv} -o c.csv", ["c.csv", "c.uwb"]),
    *((f"uwbsim predict --protocol {name} --final-delay-us 500", [name, "--final-delay"]) for name in
      ("ds-sym", "ss", "ss-cfo")),
    # Names of files that are not UTF-8, which the system accepts and DuckDB does not.
    *((line, [r"no\udcff", "must be UTF-8"]) for line in (
        "uwblink show {here}/../{no}.uwb",
        "uwbsim run noiseless -o new{no}.uwb",
        "uwblink export {f_uwb} --to csv -o {no}",
        "uwblink import csv {here}/../{no}.csv -o o.uwb",
        "uwbsim compare noiseless -o {no} -n 200 --protocols ds",
    )),
    ("uwblink send /dev/nothing {no}", ["/dev/nothing: no such port"]),
    # Files that are not recordings.
    *((line.format(name, c="{c_json}"), [named, fragment])
      for name, named, fragment in (("no.uwb", "no.uwb", "no such"), ("{cut_uwb}", "cut.uwb", "truncated"),
                                    ("{other_uwb}", "other.uwb", "not a"), ("{here}", "", "directory"))
      for line in ("uwblink show {}", "calib fit {} -o c.json", "calib apply {} -c {c} -o o.uwb",
                   "calib evaluate {} -c {c}")),
    # FIFOs are not opened.
    *((line, ["p.", "FIFO"]) for line in (
        "calib show {p_json}",
        "calib evaluate {f_uwb} -c {p_json}",
        "calib fit {p_uwb} -o o.json",
        "calib fit {f_uwb} -o o.json --group {p_toml}",
        "calib survey {f_uwb} -o o.json --known {p_toml}",
        "calib import miluv {p_json} -o o.json",
        "uwblink show {p_uwb}",
        "uwblink import csv {p_csv} -o o.uwb",
        "uwblink import csv {p_csv} --map {p_toml} -o o.uwb",
        "uwblink import guess {p_csv}",
        "uwblink import bag {p_mcap} -o o.uwb",
        "uwblink poses {f_uwb} --from {p_csv}",
        "uwblink stream {f_uwb} -c {p_json} --speed inf",
        "uwbsim run {p_toml} -o o.uwb",
        "uwbsim sweep {p_toml} -o o",
    )),
    ("uwblink show {device_uwb}", ["device.uwb"]),
    ("uwbsim run noiseless -o o.uwb --set run.seed=" + "[" * 3000, ["run.seed"]),
    # Boards that do not exist.
    *((f"uwblink {words}", ["/dev/nothing", "no such port"]) for words in (
        "info /dev/nothing", "twr /dev/nothing 2", "test /dev/nothing", "set-delay /dev/nothing 1500",
        "passive /dev/nothing on", "send /dev/nothing x", "cir /dev/nothing 2",
        "record /dev/nothing -o x.uwb --pairs all",
    )),
    *(("uwblink stream {f_uwb} " + words, naming) for words, naming in (
        ("--udp here", ["--udp"]), ("--udp 127.0.0.1:0", ["--udp"]),
        ("--udp no.such.host.invalid:9870", ["no such host"]), ("--foxglove x:y", ["--foxglove"]),
        ("--use receptions -c {c_json}", ["--use"]), ("--use receptions", ["--use"]),
        ("--dialect arduino", ["f.uwb", "--dialect"]),
        ("--rate 5", ["only be used with boards"]), ("-o g.uwb", ["only be used with boards"]),
    )),
    ("uwblink stream port --use receptions --dialect arduino", ["--use"]),
    ("uwblink stream port --ids 40", ["--ids", "--dialect"]),
    ("uwblink record port --dialect arduino --ids a -o q.uwb", ["--ids: found 'a'"]),
    ("uwblink record port --dialect arduino --ids 40 -c {c_json} -o q.uwb", ["--calibration", "--live"]),
    *((f"uwbsim {words}", naming) for words, naming in (
        ("compare icra2023/test1 -o out --protocols ss,tdoa", ["tdoa", "ss-cfo", "ds-sym"]),
        ("compare icra2023/test1 -o out --protocols ,", ["found none"]),
        ("compare icra2023/test1 -o out -n 0", ["-n", "expected 1 to"]),
        ("compare icra2023/test1 -o no/out", ["does not exist"]),
        ("predict --protocol aloha", ["aloha", "allowed"]),
        ("predict --skew-ppm nan", ["--skew-ppm", "nan"]),
        ("predict --final-delay-us 0", ["--final-delay-us", "1 or more"]),
        ("predict --tags 1", ["--tags"]),
        ("optimum no.toml", ["no such"]),
        ("sweep no.toml -o out", ["no such"]),
        ("run icra2023/test1 -o o.uwb --through-wire --set ranging.protocol=ds-sym", ["ds-sym", "boards"]),
        ("serve broadcast", ["ranging.plan: found 'broadcast'"]),
        ("run broadcast -o b.uwb --through-wire", ["ranging.plan: found 'broadcast'"]),
    )),
    ("uwblink replay {f_uwb}", ["no bytes from boards"]),
    ("uwblink replay {f_uwb} --serve", ["no bytes from boards"]),
    ("uwblink replay no.uwb", ["no such"]),
    ("uwbsim serve {bench} --link-dir mine --duration 1", ["tag10"]),
    ("uwbsim serve {bench} --poses mine --duration 1", ["--force"]),
]  # fmt: skip
TAGS = "[[tags]]\nid = 1\nbody = 'robot1'\n"
TAGS_LINE = "uwblink poses {f_uwb} --from {poses_csv} --tags own.toml"
OWN = [
    # As a constant, the name of a column would be the id of a tag in all rows.
    (
        "uwblink import csv {r_csv} --map own.toml -o o.uwb",
        ["r.csv", "constants.from_id", "'to_id'", "[columns]"],
        '[constants]\nfrom_id = "to_id"\n',
    ),
    # Nested too deeply.
    *((line, ["own.toml"], DEEP) for line in (
        "uwbsim validate own.toml",
        "uwbsim sweep own.toml -o o",
        "uwbsim serve noiseless --faults own.toml",
        "uwblink import csv {r_csv} --map own.toml -o o.uwb",
        "calib survey {f_uwb} --known own.toml -o o.json",
    )),
    # Served poses do not replace an input.
    *((f"{line} --duration 0.1 --force", ["--poses", "is also an input"], text) for line, text in (
        ("uwbsim serve own.toml --poses own.toml", BENCH.read_text()),
        ("uwbsim serve {bench} --faults own.toml --poses own.toml", ""),
    )),
    # Misspelt keys.
    (TAGS_LINE, ["own.toml", "lever_arm"], TAGS + "lever_arm = [0.1, 0.0, 0.0]\n"),
    (TAGS_LINE, ["own.toml", "sigma_m"],
     TAGS + "[[anchors]]\nid = 2\nposition_m = [0.0, 0.0, 1.0]\nsigma_m = 0.1\n"),
    (TAGS_LINE, ["own.toml", "anchor"], TAGS + "[[anchor]]\nid = 2\n"),
    ("uwblink record none -o o.uwb --plan own.toml", ["own.toml", "lever_arm"], TAGS + "lever_arm = [0.1, 0.0, 0.0]\n"),
    ("uwblink record none -o o.uwb --plan own.toml", ["own.toml", "rate"], "rate = 3\n" + TAGS),
    ("calib survey {f_uwb} -o o.json --known own.toml", ["own.toml", "betwen"], "[[distances]]\nbetwen = [1, 2]\n"),
    ("calib survey {f_uwb} -o o.json --known own.toml", ["own.toml", "shape"], "shape = 'line'\n"),
    ("uwblink import csv {r_csv} -o o.uwb --map own.toml", ["own.toml", "from"], "[columns]\nfrom = 'a'\n"),
    ("uwblink import csv {r_csv} -o o.uwb --map own.toml", ["own.toml", "transmit"],
     "[antenna_delays]\ntransmit = 3\n"),
    ("uwblink import csv {r_csv} -o o.uwb --map own.toml", ["own.toml", "from_temperature_c", "400", "-65 to 150"],
     "[constants]\nfrom_temperature_c = 400\n"),
    ("uwbsim sweep own.toml -o o", ["own.toml", "seed"], "[sweep]\nscenario = 'noiseless'\nseed = 3\n"),
    ("uwbsim sweep own.toml -o o", ["own.toml", "rx_noise"],
     "sweep = {scenario = 'noiseless', design = 'list', protocols = ['ds'], ranges = 10}\n"
     "[[list]]\n'radio.rx_noise_ps' = 50.0\n[[list]]\n'radio.rx_noise' = 50.0\n"),
    *(("uwbsim serve {bench} --faults own.toml --duration 1", ["own.toml", *named], text) for named, text in (
        (["at"], "faults = [{kind = 'unplug', tag = 10, at = 1.0}]\n"),
        (["faults", "flood"], "[[faults]]\nkind = 'flood'"),
        (["faults[0].tag", "99", "10, 20"], "[[faults]]\nkind = 'hang'\ntag = 99\nat_s = 1"),
        (["share"], "[[faults]]\nkind = 'lose-frames'\nshare = 2"),
        (["not valid TOML"], "faults = ["),
    )),
    *(("uwbsim run own.toml -o o.uwb", ["own.toml", *named], NOISELESS.replace(old, new, 1))
      for old, new, named in SCENARIOS),
    *(("uwblink import csv own.csv -o o.uwb", ["own.csv", *named], text) for text, named in TABLES),
    *(("calib fit {f_uwb} -o c.json --group own.toml", ["--group", *named], text) for text, named in GROUPS),
    ("calib fit {f_uwb} -o c.json --delays-only --group own.toml", ["--group", "--delays-only"], "[groups]\na = [1]"),
    *(("calib evaluate {f_uwb} -c own.json", named, text) for text, named in (
        ("{", ["not JSON"]),
        ("[]", ["not a calibration"]),
        ('{"schema_version": 99}', ["99"]),
        ('{"schema_version": 8}', ["schema version 8", "reads 1 to 7"]),
        ('{"schema_version": 1}', ["missing"]),
        ('{"schema_version": 1, "lift": "up"}', ["mean-of-lifted"]),
    )),
    ("uwbsim twin {f_uwb} -c own.json -o t.toml", ["no schema_version"], "{}"),
    ("calib import miluv own.json -o c.json", ["own.json", "delays_ns"], json.dumps(PUBLISHED)),
]  # fmt: skip


@pytest.mark.parametrize(("line", "naming", "text"), [*((line, naming, "") for line, naming in WORDS), *OWN])
def test_mistakes_are_named_and_nothing_is_written(seeds, tmp_path, line, naming, text):
    line = line.replace("{here}/../", f"{seeds}/")
    refused(seeds, tmp_path, line, naming, text)


@pytest.fixture(scope="module")
def ports():
    with served() as server:
        yield server.names


@pytest.mark.parametrize(
    ("line", "naming"),
    [
        ("twr {one} 1", ["own id"]),
        ("twr {one} 9", ["COMMANDED TASK FAILED AFTER 5 ATTEMPTS"]),
        ("twr {one} 2 --protocol tdoa", ["tdoa", "ds and ss"]),
        ("set-delay {one} 279", ["279", "280 to 6500"]),
        ("set-delay {one} 100000", ["100000", "280 to 6500"]),
        ("passive {one} maybe", ["maybe", "on or off"]),
        ("send {one} " + "x" * 58, ["58 bytes", "at most 57", "one USB packet"]),
        ("cir {one} 2 --plot {here}/c.xyz", [".xyz", ".png"]),
        ("record {one} {two} -o f.uwb --plan own.toml", ["contains 9", "1, 2"]),
        ("record {one} {two} -o f.uwb", ["--plan", "--pairs"]),
        ("record {one} {two} -o f.uwb --pairs some", ["some"]),
        ("record {one} {two} -o f.uwb --plan no.toml", ["no.toml"]),
        ("record {one} -o f.uwb --pairs all", ["two boards that range"]),
        ("record {one} {two} -o f.uwb --pairs all -c no.json", ["--live"]),
        ("record {one} {two} -o f.uwb --pairs all --live --calibration no.json", ["no.json"]),
        ("info {silent}", ["b'C07\\r'", "heard nothing", "check that this is a ranging board"]),
    ],
)
def test_mistakes_with_boards_and_recorders_are_named(seeds, ports, tmp_path, line, naming):
    silent = Terminal()
    names = {"one": ports[1], "two": ports[2], "silent": silent.name}
    refused(seeds, tmp_path, f"uwblink {line}", naming, "pairs = [[1, 9]]", **names)
    silent.unplug()


def test_ports_that_are_and_are_not_boards(ports):
    silent = Terminal()
    told = succeed("uwblink", "ports", "--probe", ports[1], silent.name, timeout=180).stdout
    assert ("board 1" in told, "no answer" in told) == (True, True)
    silent.unplug()


def test_a_second_server_does_not_take_the_links_of_the_first(tmp_path):
    first = Terminal(tmp_path / "tag1")
    with pytest.raises(uwblink.errors.PortError, match="in use by another server"):
        Terminal(tmp_path / "tag1")
    (tmp_path / "tag1").unlink()  # as the error says
    second = Terminal(tmp_path / "tag1")
    first.unplug()
    assert (tmp_path / "tag1").exists()
    second.unplug()
    (tmp_path / "tag1").symlink_to(tmp_path / "gone")
    Terminal(tmp_path / "tag1").unplug()


@pytest.fixture
def numbered(tmp_path, monkeypatch):
    """Pseudo-terminals with the names pts0, pts1 ..., as the system gives the smallest names that are free."""
    real, devices = pty.openpty, dict[int, str]()

    def openpty():
        ends = real()
        devices[ends[1]] = str(tmp_path / f"pts{len(devices)}")
        Path(devices[ends[1]]).touch()
        return ends

    monkeypatch.setattr(pty, "openpty", openpty)
    monkeypatch.setattr(os, "ttyname", devices.__getitem__)


@pytest.mark.parametrize("names", [(0, 1, 2), (1, 2, 0), (2, 1, 0)])
def test_a_server_takes_over_the_links_of_a_killed_one(tmp_path, numbered, names):
    """The links lead to terminals that the new server opens again, also for another board."""
    for tag, name in enumerate(names, 1):
        (tmp_path / f"tag{tag}").symlink_to(tmp_path / f"pts{name}")
    server = uwbsim.Server(bench_scenario(), tmp_path)
    assert [(tmp_path / f"tag{tag}").readlink().name for tag in (1, 2, 3)] == ["pts0", "pts1", "pts2"]
    server.close()
    assert not [*tmp_path.glob("tag*")]


def test_terminals_of_which_one_cannot_have_its_link_leave_no_other_link(tmp_path):
    record_bench(tmp_path / "r.uwb", duration_s=0.5)
    (tmp_path / "tag2").write_text("mine")
    with uwblink.Recording.open(tmp_path / "r.uwb") as recording, pytest.raises(uwblink.errors.PortError, match="tag2"):
        uwblink.boards.play(recording, lambda names: None, link_dir=tmp_path)
    with pytest.raises(uwblink.errors.PortError, match="tag2"):
        uwbsim.Server(bench_scenario(), tmp_path)
    assert [(path.name, path.read_text()) for path in tmp_path.glob("tag*")] == [("tag2", "mine")]


@pytest.mark.slow
def test_the_command_printed_by_a_server_records_and_replay_repeats_it(tmp_path, ports):
    said = succeed("uwbsim", "serve", BENCH, "--link-dir", tmp_path / "ports", "--duration", 0.1)
    assert said.stdout.startswith("tag  10  ")
    assert f"uwblink record {tmp_path / 'ports'}/* --pairs all -o flight.uwb" in said.stderr
    succeed("uwblink", "record", ports[1], ports[2], "-o", "f.uwb", "--pairs", "all", "--duration", 2, cwd=tmp_path)
    for words, told in (
        (("--serve", "--speed", 10, "--link-dir", "again"), "pieces played"),
        (("-o", "again.uwb", "--json"), '"skipped_bytes": 0'),
    ):
        assert told in succeed("uwblink", "replay", "f.uwb", *words, cwd=tmp_path).stdout
    assert (tmp_path / "again.uwb").exists()


@pytest.mark.parametrize(
    "line",
    [
        "calib export {c_json} --to csv --force -o own.there",
        "calib fit {f_uwb} --force -o own.there",
        "calib apply {f_uwb} -c {c_json} --force -o own.there",
        "uwblink import guess {r_csv} --force -o own.there",
    ],
)
def test_no_fifo_or_device_is_replaced(seeds, tmp_path, line):
    os.mkfifo(tmp_path / "there")
    refused(seeds, tmp_path, line.replace("own.", "./"), ["there", "FIFO"])
    assert (tmp_path / "there").is_fifo()


def test_a_folder_with_something_else_in_it_is_not_replaced(seeds, tmp_path):
    """`--force` of an export deletes an earlier export, and nothing else."""
    export = "uwblink export {f_uwb} --to csv --force -o out"
    for _ in range(2):
        succeed(*export.format(f_uwb=seeds / "f.uwb").split(), cwd=tmp_path)
    (tmp_path / "out" / "deep").mkdir()
    (tmp_path / "out" / "deep" / "thesis.txt").write_text("mine")
    refused(seeds, tmp_path, export, ["out", "contains deep"])


def nothing(*names):
    return {name: np.full(COUNT, np.nan) for name in names}


SAMPLE, POSES = calib.sample_flight(COUNT).exchanges, calib.sample_flight(COUNT).poses
FIT = "calib fit {here}/bad.uwb -o c.json"


@pytest.mark.parametrize(
    ("change", "line", "naming"),
    [
        (nothing("fpp1_dbm", "fpp2_dbm"), FIT, ["bad.uwb", "no power"]),
        ({"fpp1_dbm": np.zeros(COUNT), "fpp2_dbm": np.full(COUNT, 3.0)}, FIT, ["bad.uwb", "no power", "+3 dBm"]),
        ({"rx2": SAMPLE.rx2 + 2**30 & 2**32 - 1}, FIT, ["bad.uwb", "none of its", "no range within 10 km"]),
        (
            {"poses": replace(POSES, time_ns=POSES.time_ns + 10**11)},
            FIT,
            ["poses cover 0.0 to 11.0 s", "exchanges -99.0 to -90.0 s", "--offset"],
        ),
        ({"poses": POSES[:0]}, FIT, ["bad.uwb", "no true distance"]),
        ({"rows": slice(60)}, FIT, ["too few"]),
        ({"tags": []}, FIT, ["it has no tags with bodies and lever arms", "--tags"]),
        ({"poses": replace(POSES, position_m=POSES.position_m * 1000)}, FIT, ["bad.uwb", "millimetres"]),
        ({"fpp1_dbm": -SAMPLE.fpp1_dbm, "fpp2_dbm": -SAMPLE.fpp2_dbm}, FIT, ["bad.uwb", "dBm"]),
        (
            {"rows": slice(99)},
            "uwbsim twin {here}/bad.uwb -c {c_json} -o t.toml",
            ["99 exchanges, but a twin needs 100 or more"],
        ),
        # Two pairs do not determine three delays.
        ({"tags": []}, "uwbsim twin {here}/bad.uwb -c {c_json} -o t.toml", ["tag 1, 2, 3", "uwblink poses --tags"]),
        (
            {"time_ns": np.zeros(COUNT, np.int64)},
            "calib localize {here}/bad.uwb -c {c_json}",
            ["all of its 900 ranges have the same time"],
        ),
        (
            nothing("fpp1_dbm", "fpp2_dbm"),
            "calib localize {here}/bad.uwb -c {c_json}",
            ["bad.uwb", "no power; a calibration without a curve needs no power: use `calib fit --delays-only`"],
        ),
    ],
)
def test_undetermined_results_have_status_1(seeds, tmp_path, change, line, naming):
    changed(tmp_path / "bad.uwb", **change)
    refused(seeds, tmp_path, line, naming, status=1)


def test_poses_of_a_part_of_the_flight_are_enough_for_a_warning(tmp_path):
    cut = changed(tmp_path / "cut.uwb", poses=POSES[POSES.time_ns < 64 * 10**8])
    done = succeed("calib", "fit", cut, "-o", tmp_path / "c.json")
    assert "40 % of the exchanges were left out: no true distance" in done.stderr


def test_a_calibration_without_a_tag_of_the_recording_is_refused(seeds, tmp_path):
    table = json.loads((seeds / "c.json").read_text())
    del table["delays_ns"]["3"]
    refused(seeds, tmp_path, "calib evaluate {f_uwb} -c own.json", ["no delay of tag 3"], json.dumps(table))


def test_delays_without_standard_errors_are_not_taken_for_exact(seeds, tmp_path):
    fitted = calib.load_calibration(seeds / "c.json")
    delays = {str(tag): delay + 0.3 * (tag == 2) for tag, delay in fitted.delays_ns.items()}
    (tmp_path / "m.json").write_text(json.dumps(PUBLISHED | {"delays_ns": delays}))
    succeed("calib", "import", "miluv", "m.json", "-o", "c.json", cwd=tmp_path)
    words = ("calib", "compare", seeds / "c.json", "c.json")
    found = json.loads(run(*words, "--json", cwd=tmp_path).stdout)
    assert (found["verdict"], found["probability"], set(found["std_ns"].values())) == ("unknown", None, {None})
    assert found["difference_ns"]["2"] - found["difference_ns"]["1"] == pytest.approx(0.3)
    for line, told in (
        (words, "not tested"),
        (("calib", "show", "c.json"), "not stated"),
        (("calib", "export", "c.json", "--to", "csv"), ",\n"),
    ):
        assert told in run(*line, cwd=tmp_path).stdout


@pytest.mark.slow
def test_commands_without_powers_work(tmp_path):
    path = changed(tmp_path / "f.uwb", anchors=True, **nothing("fpp1_dbm", "fpp2_dbm"))
    (finding,) = calib.examine(path)
    assert (finding.fault, finding.evidence) == ("no powers", "0 % of the exchanges have a first-path power")
    calib.fit(path, delays_only=True).calibration.save(tmp_path / "d.json")
    succeed("calib", "localize", path, "-c", tmp_path / "d.json", "--model", "constant-velocity")
    one_end = changed(tmp_path / "one.uwb", **nothing("fpp2_dbm"))
    assert "no powers" not in {found.fault for found in calib.examine(one_end)}


@pytest.mark.parametrize("share", [0.01, 1.0])
def test_a_tag_that_ranges_with_itself_is_named_and_left_out(share, tmp_path):
    rows = np.arange(COUNT) < share * COUNT
    path = changed(tmp_path / "f.uwb", target=np.where(rows, SAMPLE.initiator, SAMPLE.target))
    assert "a tag with itself" in {f.fault for f in calib.examine(path)}
    if share == 1:
        with pytest.raises(calib.UnanswerableError, match="a tag with itself; check from_id and to_id"):
            calib.fit(path)
    else:
        assert calib.load_ranges(path).excluded == {"a tag with itself": rows.sum()}


def test_a_twin_does_without_exchanges_of_a_tag_with_itself(tmp_path):
    flight = uwbsim.simulate(uwbsim.load("icra2023/test1", {"run.duration_s": 5.0}))
    target = flight.exchanges.target.copy()
    target[::50] = flight.exchanges.initiator[::50]
    mixed = replace(flight, exchanges=replace(flight.exchanges, target=target))
    calib.fit(flight).save(tmp_path / "k.json")
    with_itself, whole = (uwbsim.twin(data, tmp_path / "k.json").found for data in (mixed, flight))
    assert with_itself["exchanges"] == whole["exchanges"] - len(target[::50])
    # Two fewer in a hundred give the same to a few per cent.
    assert with_itself["receive_noise_ps"] == pytest.approx(whole["receive_noise_ps"], rel=0.1)


def test_empty_recordings_can_be_written_and_read():
    assert (
        len(uwblink.Poses.from_arrays([], [], [])),
        len(uwblink.Poses.from_arrays([], "drone", np.zeros((0, 3)))),
    ) == (0, 0)
    assert len(uwblink.Exchanges.from_arrays([], [], tx1=[], rx1=[], tx2=[], rx2=[])) == 0


def test_evaluating_ranges_of_the_first_calibrated_tags_only():
    """A simulation plants delays of tags that do not range in the evaluated part."""
    flight = calib.sample_flight(anchors=True)
    known = calib.fit(flight).calibration
    planted = {"knots": [0.0] * 4 + [2.0] * 4, "coefficients": [0.0, 0.01, 0.02, 0.03], "degree": 3}
    ranges = calib.load_ranges(flight)
    ranges = replace(ranges, planted={**(ranges.planted or {}), "bias_curve": planted})
    some = ranges[(ranges.initiator <= 2) & (ranges.target <= 2)]
    of_some, of_all = (calib.evaluate(data, known).planted.delay_error_ns for data in (some, ranges))
    assert of_some == of_all


def test_the_delay_of_the_final_changes_the_prediction_of_protocols_that_have_one():
    words = ("uwbsim", "predict", "--protocol", "ds-alt", "--json")
    quick, usual = (json.loads(run(*words, *more).stdout)["std_m"] for more in (("--final-delay-us", "300"), ()))
    assert quick != usual


def test_text_is_written_under_names_that_are_no_utf8(seeds, tmp_path):
    (tmp_path / f"{NO_UTF8}.json").write_bytes((seeds / "c.json").read_bytes())
    succeed("calib", "export", f"{NO_UTF8}.json", "--to", "c-header", "-o", "c.h", cwd=tmp_path)
    assert (tmp_path / "c.h").read_text(encoding="utf-8")
