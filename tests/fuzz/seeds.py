"""Sound files of every kind that commands take, and the commands that take them."""

from __future__ import annotations

import gzip
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

import calib
import uwblink
import uwbsim
from tests.fuzz.mutations import BINARY, JSON, TEXT, Mutation
from uwblink.exporters import export_recording

ROOT: Final = Path(__file__).parents[2]

SCENARIO: Final = "scenarios/noiseless.toml"


class Kind(NamedTuple):
    """A kind of file: its name in the folder of seeds, what damages it, and commands with `{}` in its place.

    `{out}` is an output that is not there, `{name}` any other seed.
    """

    file: str
    mutations: Sequence[Mutation]
    commands: Sequence[str]


RECORDING_COMMANDS: Final = (
    "uwblink show {}",
    "uwblink show {} --json",
    "uwblink export {} --to csv -o {out}",
    "uwblink export {} --to mcap -o {out}",
    "uwblink export {} --to tum -o {out}",
    "uwblink replay {} -o {out}",
    "calib fit {} -o {out}",
    "calib fit {} -o {out} --loss cauchy",
    "calib fit {} -o {out} --truth ranges --poses-until 1",
    "calib survey {} --known plane -o {out}",
    "calib compare {calibration.json} {calibration.json}",
    "calib evaluate {} -c {calibration.json}",
    "calib localize {} -c {calibration.json}",
    "calib apply {} -c {calibration.json} -o {out}",
    "calib doctor {}",
)

KINDS: Final = (
    Kind("flight.uwb", (), RECORDING_COMMANDS),
    Kind("flight.uwb", BINARY, RECORDING_COMMANDS),
    Kind(
        "calibration.json",
        JSON,
        (
            "calib evaluate {flight.uwb} -c {}",
            "calib apply {flight.uwb} -c {} -o {out}",
            "calib compare {} {calibration.json}",
            "calib show {}",
            "calib import miluv {} -o {out}",
            "calib localize {flight.uwb} -c {}",
            *(
                f"calib export {{}} --to {form} -o {{out}}"
                for form in ("registers", "json", "csv", "miluv", "ros-yaml", "c-header")
            ),
        ),
    ),
    Kind(
        "scenario.toml",
        TEXT,
        ("uwbsim run {} -o {out}", "uwbsim validate {}", "uwbsim predict {}", "uwbsim show {} -o {out}"),
    ),
    Kind("table.csv", TEXT, ("uwblink import csv {} -o {out}", "uwblink import guess {} -o {out}")),
    Kind("table.csv.gz", BINARY, ("uwblink import csv {} -o {out}",)),
    Kind("map.toml", TEXT, ("uwblink import csv {table.csv} --map {} -o {out}",)),
    Kind("poses.tum", TEXT, ("uwblink poses {live.uwb} --from ifo001={}",)),
    Kind(
        "known.toml",
        TEXT,
        ("calib survey {flight.uwb} --known {} -o {out}", "calib survey {flight.uwb} --known {} -o {out} --json"),
    ),
    Kind(
        "plan.toml",
        TEXT,
        ("calib plan 4 --on plane --taped 2 --tape-sigma 0.01 --size 3,4", "uwbsim sweep {} -o {out} --workers 1"),
    ),
    Kind("tags.toml", TEXT, ("uwblink poses {live.uwb} --from ifo001={poses.tum} --tags {}",)),
)


def write_seeds(folder: Path) -> None:
    """Write a sound file of every kind into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    scenario = (ROOT / SCENARIO).read_text()
    short = scenario.replace("duration_s = 60.0", "duration_s = 3.0")
    (folder / "scenario.toml").write_text(short)
    simulated = uwbsim.simulate(folder / "scenario.toml")
    simulated.save(folder / "flight.uwb")
    calib.fit(simulated).calibration.save(folder / "calibration.json")
    recording = uwblink.load(folder / "flight.uwb")
    replace(recording, poses=recording.poses[:0]).save(folder / "live.uwb")
    export_recording(folder / "flight.uwb", folder / "exported", to="tum")
    shutil.copyfile(next((folder / "exported").glob("ifo001*")), folder / "poses.tum")
    (folder / "tags.toml").write_text("".join(_tag(tag) for tag in recording.tags))
    (folder / "map.toml").write_text(MAP)
    (folder / "known.toml").write_text(KNOWN)
    (folder / "plan.toml").write_text(PLAN)
    table = (ROOT / "docs/examples/exchanges.csv").read_bytes()
    (folder / "table.csv").write_bytes(table)
    (folder / "table.csv.gz").write_bytes(gzip.compress(table, mtime=0))


def _tag(tag: uwblink.Tag) -> str:
    return f'[[tags]]\nid = {tag.tag}\nbody = "{tag.body}"\nlever_arm_m = {list(tag.lever_arm_m)}\n'


KNOWN: Final = """known = "plane"

[[distances]]
between = [1, 3]
distance_m = 2.0
sigma_m = 0.01

[[positions]]
tag = 5
position_m = [1.0, 2.0, 0.5]

[[arrangements]]
name = "first"
start_s = 0.0
end_s = 2.0
"""

PLAN: Final = """[sweep]
scenario = "scenario.toml"
protocols = ["ss", "ds"]
ranges = 20
seeds = 1

[vary]
"ranging.response_delay_uus" = [300, 1500]
"radio.rx_noise_ps" = [10.0, 100.0]
"""

MAP: Final = """protocol = "ds"
bits = 32

[columns]
time_s = "time_s"
from_id = "from_id"
tx1 = "tx1"
fpp1 = "fpp1"
gt_range_m = "gt_range_m"

[units]
stamps = "ticks"
time = "s"
distance = "m"
"""
