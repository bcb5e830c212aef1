"""Sound files of every kind that commands read, and the commands that read them."""

from __future__ import annotations

import gzip
import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

import duckdb

import calib
import uwblink
import uwbsim
from tests.fuzz.mutations import BINARY, JSON, TEXT, Mutation
from tests.uwblink.importers import test_forms, test_table_forms
from tests.uwblink.importers import test_poses as poses
from uwblink.exporters import export_recording

ROOT: Final = Path(__file__).parents[2]

NEW_TAG: Final = 6


GUESS: Final = "uwblink import guess {} -o {out}"


class Kind(NamedTuple):
    """A kind of file: its place in the folder of seeds, its share, mutations, and commands with `{}` in its place.

    `{folder}` is the folder of the file, `{out}` an output that does not exist, `{name}` any other seed. Commands that
    take longer, such as pages with figures, are drawn once in `SELDOM` times.
    """

    file: str
    share: float
    mutations: Sequence[Mutation]
    commands: Sequence[str]
    seldom: Sequence[str] = ()


SELDOM: Final = 300

RECORDING_COMMANDS: Final = (
    "uwblink show {}",
    "uwblink show {} --json",
    "uwblink export {} --to csv -o {out}",
    "uwblink export {} --to parquet -o {out}",
    "uwblink export {} --to mcap -o {out}",
    "uwblink export {} --to rosbag2 -o {out}",
    "uwblink export {} --to tum -o {out}",
    "uwblink poses {} --from ifo001={poses.tum}",
    "uwblink stream {} --speed inf -c {calibration.json}",
    "uwblink stream {} --speed inf --quiet",
    "calib fit {} -o {out}",
    "calib fit {} -o {out} --loss cauchy --json",
    "calib fit {} -o {out} --sequential",
    "calib fit {} -o {out} --constants pair",
    "calib fit {} -o {out} --delays-from {calibration.json}",
    "calib fit {} -o {out} --truth ranges --poses-until 1",
    "calib add-tag {} -c {others.json} --tag 6 -o {out}",
    "calib survey {} --known plane -o {out}",
    "calib evaluate {} -c {calibration.json}",
    "calib evaluate {} -c {calibration.json} --json",
    "calib localize {} -c {calibration.json}",
    "calib localize {} -c {calibration.json} --tum {out}",
    "calib apply {} -c {calibration.json} -o {out}",
    "calib doctor {}",
    "calib doctor {} {flight.uwb} --json",
)

BOARDS_COMMANDS: Final = (
    "uwblink show {}",
    "uwblink replay {} -o {out}",
    "uwblink replay {} -o {out} --json",
    "uwblink export {} --to csv -o {out}",
    "uwblink stream {} --speed inf -c {calibration.json}",
    "uwblink poses {} --from ifo001={poses.tum} --offset auto --tags {tags.toml}",
    "calib doctor {}",
)

RECORDING_PAGES: Final = (
    "calib report {} -o {out}.html",
    "calib evaluate {} -c {calibration.json} --report {out}.html",
    "uwbsim twin {} -c {calibration.json} -o {out} --seeds 1",
)

ALONE: Final = (
    "calib plan survey 4 --on plane --taped 2 --tape-sigma 0.01 --size 3,4",
    "calib plan survey 1,2,3,4 --on space --anchor-tags 1,2,3 --anchor-sigma 0.01 --pair-error 0.02 --rate 50 --json",
    "calib plan survey 3 --on line --arrangements 3 --size 5",
    "calib plan flight 4 --duration 20",
    "calib sample -o {out} -n 50 --seed 2",
    "calib sample -o {out} -n 50 --with-anchors",
    "uwbsim scenarios icra2023 -o {out}",
    "uwbsim scenarios --json",
    "uwbsim schema",
    "uwbsim run {scenario.toml} -o {out} --set run.duration_s=0.5",
    "uwbsim validate {scenario.toml} --set radio.rx_noise_ps=10",
    "uwbsim predict --protocol ss-cfo --skew-ppm 10 --reply-delay-us 300",
    "uwbsim predict --protocol ds-alt --final-delay-us 900 --rx-noise-ps 100 --json",
    "uwbsim optimum {scenario.toml} --protocols ds --overhead-us 10 --json",
    "calib export {calibration.json} --to registers -o {out}",
    "calib fit {flight.uwb} -o {out} --fix 1=-0.36 --reference-power -82 --loss cauchy --scale 0.1",
    "calib fit {flight.uwb} -o {out} --truth ranges --poses-until 1 --attitudes none --heading-std 3",
)
"""Commands of which only options are damaged."""

KINDS: Final = (
    Kind("flight.uwb", 12, (), RECORDING_COMMANDS, RECORDING_PAGES),
    Kind("flight.uwb", 4, BINARY, RECORDING_COMMANDS, RECORDING_PAGES),
    Kind("boards.uwb", 3, (), BOARDS_COMMANDS),
    Kind(
        "calibration.json",
        22,
        JSON,
        (
            "calib evaluate {flight.uwb} -c {}",
            "calib apply {flight.uwb} -c {} -o {out}",
            "calib compare {} {calibration.json}",
            "calib compare {calibration.json} {} --json",
            "calib show {}",
            "calib show {} --json",
            "calib import miluv {} -o {out}",
            "calib localize {flight.uwb} -c {}",
            "calib add-tag {flight.uwb} -c {} --tag 6 -o {out}",
            "calib fit {flight.uwb} -o {out} --delays-from {}",
            "uwblink stream {flight.uwb} --speed inf -c {}",
            *(
                f"calib export {{}} --to {form} -o {{out}}"
                for form in ("registers", "firmware", "json", "csv", "miluv", "ros-yaml", "c-header")
            ),
        ),
        ("calib evaluate {flight.uwb} -c {} --report {out}.html", "uwbsim twin {flight.uwb} -c {} -o {out} --seeds 1"),
    ),
    Kind(
        "scenario.toml",
        20,
        TEXT,
        (
            "uwbsim run {} -o {out}",
            "uwbsim run {} -o {out} --through-wire",
            "uwbsim validate {}",
            "uwbsim validate {} --json",
        ),
        ("uwbsim show {} -o {out}.html", "uwbsim compare {} -o {out} -n 200", "uwbsim optimum {} --protocols ds"),
    ),
    Kind("table.csv", 10, TEXT, ("uwblink import csv {} -o {out}", "uwblink import guess {} -o {out}")),
    Kind("table.csv.gz", 2, BINARY, ("uwblink import csv {} -o {out}",)),
    Kind("table.jsonl", 4, (*TEXT, *JSON), ("uwblink import csv {} -o {out}", "uwblink import guess {} -o {out}")),
    Kind("table.parquet", 2, BINARY, ("uwblink import csv {} -o {out}",)),
    Kind("exported/exchanges.csv", 1, TEXT, ("uwblink import exported {folder} -o {out}",)),
    Kind("exported/poses.csv", 1, TEXT, ("uwblink import exported {folder} -o {out}",)),
    Kind("flight.mcap", 3, BINARY, ("uwblink import bag {} -o {out}", "uwblink poses {live.uwb} --from {}")),
    Kind("map.toml", 4, TEXT, ("uwblink import csv {table.csv} --map {} -o {out}",)),
    Kind("poses.tum", 3, TEXT, ("uwblink poses {live.uwb} --from ifo001={}",)),
    Kind("poses.csv", 2, TEXT, ("uwblink poses {live.uwb} --from {}",)),
    Kind("form_wide.csv", 2, TEXT, ("uwblink import csv {} --map {form_wide.toml} -o {out}", GUESS)),
    Kind("form_wide.toml", 3, TEXT, ("uwblink import csv {form_wide.csv} --map {} -o {out}",)),
    Kind("form_uart.log", 3, (*TEXT, *BINARY), ("uwblink import csv {} --map {form_log.toml} -o {out}", GUESS)),
    Kind("form_log.toml", 3, TEXT, ("uwblink import csv {form_uart.log} --map {} -o {out}",)),
    Kind("form_ranges.jsonl", 2, JSON, ("uwblink import csv {} --map {form_list.toml} -o {out}", GUESS)),
    *(
        Kind(name, 1, TEXT, ("uwblink poses {live.uwb} --from {}",))
        for name in ("form_m.csv", "form_v.csv", "form_q.tsv")
    ),
    Kind(
        "known.toml",
        3,
        TEXT,
        ("calib survey {flight.uwb} --known {} -o {out}", "calib survey {flight.uwb} --known {} -o {out} --json"),
    ),
    Kind("groups.toml", 2, TEXT, ("calib fit {flight.uwb} -o {out} --loss cauchy --group {}",)),
    Kind("faults.toml", 1, TEXT, ("uwbsim serve {scenario.toml} --faults {} --duration 0.01",)),
    Kind("results/results.duckdb", 1, BINARY, ("uwbsim sweep {plan.toml} -o {folder} --resume --workers 1",)),
    Kind("plan.toml", 0.1, TEXT, ("uwbsim sweep {} -o {out} --workers 1",)),
    Kind("tags.toml", 3, TEXT, ("uwblink poses {live.uwb} --from ifo001={poses.tum} --tags {}",)),
    Kind("nothing", 8, (), ALONE),
)


def write_seeds(folder: Path) -> None:
    """Write a small sound file of every kind into a folder, so that a case takes hundredths of a second."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in TEXTS.items():
        (folder / name).write_text(text)
    _write_flights(folder)
    _write_tables(folder)
    uwbsim.run_sweep(uwbsim.load_design(folder / "plan.toml"), folder / "results", workers=1)


def _write_flights(folder: Path) -> None:
    """Write a scenario, a recording of it, and calibrations from that."""
    scenario = (ROOT / "scenarios/noiseless.toml").read_text()
    (folder / "scenario.toml").write_text(scenario.replace("duration_s = 60.0", "duration_s = 2.0"))
    simulated = uwbsim.simulate(folder / "scenario.toml")
    simulated.save(folder / "flight.uwb")
    calib.fit(simulated).calibration.save(folder / "calibration.json")
    recording = uwblink.load(folder / "flight.uwb")
    x = recording.exchanges
    others = replace(recording, exchanges=x[(x.initiator != NEW_TAG) & (x.target != NEW_TAG)])
    calib.fit(others).calibration.save(folder / "others.json")
    replace(recording, poses=recording.poses[:0]).save(folder / "live.uwb")
    ports = uwbsim.VirtualPorts(uwbsim.load(folder / "scenario.toml"))
    uwblink.record([*ports.names.values()], folder / "boards.uwb", uwblink.RangingPlan(), using=ports, duration_s=1.5)
    (folder / "tags.toml").write_text("".join(_tag(tag) for tag in recording.tags))


def _write_tables(folder: Path) -> None:
    """Write tables, trajectories and a bag."""
    table = (ROOT / "docs/examples/exchanges.csv").read_bytes()
    (folder / "table.csv").write_bytes(table)
    (folder / "table.csv.gz").write_bytes(gzip.compress(table, mtime=0))
    duckdb.sql(f"COPY (FROM '{folder}/table.csv' LIMIT 10) TO '{folder}/table.jsonl' (FORMAT json)")
    live = folder / "flight.uwb"
    export_recording(live, folder / "parquet", to="parquet")
    shutil.copyfile(folder / "parquet/exchanges.parquet", folder / "table.parquet")
    export_recording(live, folder / "exported", to="csv")
    export_recording(live, folder / "mcap", to="mcap")
    shutil.copyfile(next((folder / "mcap").glob("*.mcap")), folder / "flight.mcap")
    export_recording(live, folder / "tum", to="tum")
    _write_forms(folder)
    for source, name in (
        (next((folder / "tum").glob("ifo001*")), "poses.tum"),
        (folder / "exported/poses.csv", "poses.csv"),
    ):
        (folder / name).write_text("".join(source.read_text().splitlines(keepends=True)[:300]))


def _write_forms(folder: Path) -> None:
    """Write files of other forms, and their maps, as the tests of these forms do."""
    constants = "[constants]\nfrom_id = 7\n"
    test_table_forms.write(folder / "form_wide.csv", test_forms.wide_rows("r_AN{}"))
    (folder / "form_wide.toml").write_text(
        'missing = [-1, "x"]\n[columns]\ntime_s = "t_s"\nfrom_id = "tag"\n[wide]\nrange_m = "r_AN{to_id}"\n'
    )
    test_forms.lines(folder / "form_uart.log", test_forms.lec)
    (folder / "form_log.toml").write_text(f'line = "dwm1001-lec"\nchip = "dw1000"\n{constants}')
    elements = [[{"anchor": r.anchor, "range_m": r.range_m} for r in some] for some in test_forms.ROUNDS]
    (folder / "form_ranges.jsonl").write_text("".join(json.dumps({"t": 1, "rx": some}) + "\n" for some in elements))
    (folder / "form_list.toml").write_text(
        f'each = "rx"\n[columns]\nto_id = "rx.anchor"\nrange_m = "rx.range_m"\n{constants}'
    )
    for name, write in (("m.csv", poses.motive), ("v.csv", poses.vicon), ("q.tsv", poses.qualisys)):
        shutil.move(write(folder), folder / f"form_{name}")


def _tag(tag: uwblink.Tag) -> str:
    return f'[[tags]]\nid = {tag.tag}\nbody = "{tag.body}"\nlever_arm_m = {list(tag.lever_arm_m)}\n'


TEXTS: Final = {
    "known.toml": """known = "plane"

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
""",
    "groups.toml": """[groups]
front = [1, 2, 3]
back = [4, 5, 6]
""",
    "plan.toml": """[sweep]
scenario = "scenario.toml"
protocols = ["ss", "ds"]
ranges = 5
seeds = 1

[vary]
"radio.rx_noise_ps" = [10.0, 100.0]
""",
    "faults.toml": """[[faults]]
kind = "unplug"
tag = 1
at_s = 0.001
for_s = 0.002
""",
    "map.toml": """protocol = "ds"
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
""",
    "nothing": "",
}
