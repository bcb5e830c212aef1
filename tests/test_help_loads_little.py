"""Help is printed before anything heavy is imported: commands import what they work with when they run.

`uwblink import` lists the table of importers, plug-ins included, so its commands may import NumPy, SciPy and DuckDB.
"""

import importlib
import json
import subprocess
import sys

import pytest
import typer

from docs.site.commands import leaves

HEAVY = ["numpy", "scipy", "duckdb", "matplotlib", "simpy", "serial", "pandas", "pypdf", "rosbags"]

SCRIPT = """
import contextlib, importlib, io, json, sys

main, seen = importlib.import_module(sys.argv[1] + ".cli").main, []
for words, heavy in [(words, json.loads(sys.argv[3])) for words in json.loads(sys.argv[2])]:
    sys.argv = [*words, "--help"]
    with contextlib.redirect_stdout(io.StringIO()) as text, contextlib.suppress(SystemExit):
        main()
    seen.append([len(text.getvalue()), [name for name in heavy if name in sys.modules]])
print(json.dumps(seen))
"""


@pytest.mark.parametrize("package", ["uwblink", "uwbsim", "calib"])
def test_help_loads_nothing_heavy(package):
    app = typer.main.get_command(importlib.import_module(f"{package}.cli.commands").app)
    commands = [(package,), *(words for words, _ in leaves(app, (package,)))]
    assert len(commands) > 5
    # What one command imports stays for those after it, so the importers come last.
    commands.sort(key=lambda words: words[1:2] == ("import",))
    script = [sys.executable, "-c", SCRIPT, package, json.dumps(commands), json.dumps(HEAVY)]
    seen = json.loads(subprocess.run(script, capture_output=True, text=True, check=True).stdout)
    for words, (length, loaded) in zip(commands, seen, strict=True):
        assert length > 100, words
        assert set(loaded) <= ({"numpy", "scipy", "duckdb"} if words[1:2] == ("import",) else set()), (
            f"{words} imports {loaded}"
        )
