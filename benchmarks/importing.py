"""Time of importing tables and poses, compared with the time in which DuckDB alone parses the table.

`python -m benchmarks.importing [ROWS]` prints processor time and peak memory, each measured in a separate process.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

ROWS = 3_800_000
POSES = 864_000
FEW = 40_000

TABLE = """
import duckdb, sys
duckdb.connect().execute(f'''COPY (SELECT 10 + i * 0.001 AS time_s, 1 + i % 3 AS from_id, 1 + (i + 1) % 3 AS to_id,
    a AS tx1, (b + 600) % 4294967296 AS rx1, (b + 30000600) % 4294967296 AS tx2, (a + 30001200) % 4294967296 AS rx2,
    (b + 115000600) % 4294967296 AS tx3, (a + 115001200) % 4294967296 AS rx3, round(-80 - 20 * random(), 4) AS fpp1,
    round(-80 - 20 * random(), 4) AS fpp2, round(random(), 4) AS skew1, round(random(), 4) AS skew2,
    round(2.8 + random() / 100, 4) AS range_m, 2.8 AS gt_range_m
    FROM (SELECT i, (random() * 4294967295)::BIGINT AS a, (random() * 4294967295)::BIGINT AS b
    FROM range({sys.argv[1]}) t(i)))
    TO 'table.csv' (HEADER)''')
"""
POSE_TABLE = """
import duckdb, sys
duckdb.connect().execute(f'''COPY (SELECT 10 + (i // 6) * 0.01 AS time_s, 'tag' || (1 + i % 3) AS body, random() AS x,
    random() AS y, random() AS z, 0.0 AS qx, 0.6 AS qy, 0.0 AS qz, 0.8 AS qw FROM range({sys.argv[1]}) t(i))
    TO 'poses.csv' (HEADER)''')
"""
MESSAGE_TABLE = """
import duckdb
cells = ', '.join(f'[{n}, tx{n}, rx{n}]' for n in (1, 2, 3))
duckdb.connect().execute(f'''COPY (SELECT time_s, CASE m[1] WHEN 1 THEN from_id ELSE to_id END AS from_id,
    CASE m[1] WHEN 1 THEN to_id ELSE from_id END AS to_id, sequence, m[1] AS message, m[2] AS tx, m[3] AS rx
    FROM (SELECT *, row_number() OVER () AS sequence, unnest([{cells}]) AS m FROM read_csv('table.csv')))
    TO 'messages.csv' (HEADER)''')
"""
PARSE = "import duckdb\nduckdb.connect().execute('SELECT * FROM read_csv(?)', ['table.csv']).fetchnumpy()"
IMPORT = "import uwblink\nuwblink.import_recording('table.csv', 'table.uwb', force=True)"
PARSE_MESSAGES, IMPORT_MESSAGES = (code.replace("table.csv", "messages.csv") for code in (PARSE, IMPORT))
ADD = (
    "from pathlib import Path\nfrom uwblink.importers import add_poses\nadd_poses(Path('table.uwb'), Path('poses.csv'))"
)
MEASURE = """
import resource
used = resource.getrusage(resource.RUSAGE_SELF)
print(f"\\n{used.ru_utime + used.ru_stime:7.2f} s {used.ru_maxrss / 1024:7.0f} MB")
"""


def main(rows: int = ROWS) -> None:
    """Print a line per task."""
    with tempfile.TemporaryDirectory() as folder:
        for name, code, argument in (
            ("", TABLE, rows),
            ("", POSE_TABLE, POSES),
            (f"DuckDB's parse of {rows} rows", PARSE + MEASURE, 0),
            (f"import of {rows} rows", IMPORT + MEASURE, 0),
            ("", MESSAGE_TABLE, 0),
            (f"DuckDB's parse of {3 * rows} messages", PARSE_MESSAGES + MEASURE, 0),
            (f"import of {3 * rows} messages", IMPORT_MESSAGES + MEASURE, 0),
            ("", TABLE, FEW),
            ("", IMPORT, 0),
            (f"{POSES} poses into {FEW} exchanges", ADD + MEASURE, 0),
        ):
            words = [sys.executable, "-c", code, str(argument)]
            done = subprocess.run(words, cwd=Path(folder), check=True, capture_output=True, text=True)
            if name:
                print(f"{name:40s}{done.stdout.splitlines()[-1]}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else ROWS)
