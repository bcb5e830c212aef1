"""Topics of a bag that may have ranges, for `uwblink import guess`: grouped by templates, with their first messages.

Topics of one message type that differ by one or two numbers or words, such as `/uwb/1/range_2` and `/uwb/1/range_3`,
are a template; what differs is the id of an initiator or a target. Which it is, the words before it tell, and which of
both the messages have themselves.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Final

from uwblink.display import first_few
from uwblink.errors import ImportTableError, raising
from uwblink.importers.bags import Bag, fields_of, matching_topics, open_bag
from uwblink.importers.column_map import IDS, POSITIONS, POWERS
from uwblink.importers.forms import name_template, named_columns, wide_columns
from uwblink.importers.poses import pose_topics
from uwblink.twr import STAMPS

if TYPE_CHECKING:
    from uwblink.importers.guess import Guess

NO_POSES: Final = (
    "no poses and no true distances: ranges alone give delays of boards that stood still (`calib survey`); a flight "
    "also needs attitudes, and anchors or first positions (calib.fit_from_ranges); constants of pairs need true "
    "distances (docs/without-motion-capture.md)"
)
MESSAGES_READ: Final = 2000
"""Messages of each group of topics that are looked at (a judgement)."""

_NUMBERS: Final = r"std_msgs/msg/(Float|U?Int)[0-9]+(MultiArray)?"
_OTHERS: Final = (
    r"^((geometry|nav|tf2|rosgraph|diagnostic|visualization|actionlib)_msgs|rcl_interfaces)/|"
    r"^sensor_msgs/msg/(?!Range )|"
    rf"^{_NUMBERS} (?!.*(uwb|rang(e|ing)|dist|dwm?[0-9]|twr))|"
    r" .*(height|altitude|lidar|laser|sonar|sonic|infrared|rangefinder|distance_sensor)"
)
"""Types and topics, with a blank between, that are of other things, and of numbers that are not called ranges."""

_WORD: Final = "([^/_]+)"
_WORDS: Final = {
    "from_id": r"tag|drone|uav|robot|rover|mobile|initiator|agent|from|src|source",
    "to_id": r"anchor|anker|target|responder|beacon|dst",
}


def guess_bag(path: Path, guess_table: Callable[..., Guess]) -> Guess:
    """Return the map of the topics of which most is recognised: stamps and powers, then ids.

    `guess_table` guesses the map of a table of messages. Raises `ImportTableError` for a bag without ranges.
    """
    found: list[tuple[Guess, list[str]]] = []
    why = "write a map with [topics]"
    with open_bag(path) as bag, TemporaryDirectory(prefix="uwblink-") as folder:
        kinds = dict(sorted(bag.kinds.items()))
        fitting = [t for t, k in kinds.items() if not re.search(_OTHERS, f"{k} {t.lower()}")]
        for kind in dict.fromkeys(kinds[topic] for topic in fitting):
            for pattern, some in _grouped([topic for topic in fitting if kinds[topic] == kind]):
                try:
                    guess = _guess_topics(bag, pattern, some, Path(folder) / "messages.jsonl", guess_table)
                    found += [(guess, some)] if guess.complete else []
                except ImportTableError as error:
                    # Most topics are of something else; only a type without definition may hide ranges.
                    why = str(error) if "has no definition" in str(error) else why
    listed = [f"{json.dumps(topic)} ({kind})" for topic, kind in kinds.items()]
    if not found:
        raise ImportTableError(f"{path}: no topic with ranges was recognised in {first_few(listed, 20)}; {why}")
    best, chosen = max(
        found, key=lambda one: (len({*STAMPS, *POWERS} & {*one[0].columns}), -len(one[0].asked), len(one[0].columns))
    )
    poses = pose_topics(path)
    advice = "" if poses or {"gt_range_m", *POSITIONS} & {*best.columns} else NO_POSES
    others = [json.dumps(topic) for _, some in found if some is not chosen for topic in some]
    remarks = ["topics of the bag:", *(f"  {one}" for one in listed)]
    remarks += [f"also with ranges, for maps of their own: {', '.join(others)}"] if others else []
    remarks += [f"poses, for `uwblink poses`: {first_few(map(json.dumps, poses))}"] if poses else []
    text = best.text + "".join(f"# {line}\n" for line in (*remarks, advice) if line)
    return replace(best, text=text, importer="bag", pose_topics=tuple(poses), advice=advice)


def _guess_topics(bag: Bag, pattern: str, topics: list[str], table: Path, guess_table: Callable[..., Guess]) -> Guess:
    """Return the map of topics of one type by their first messages, which are written as a table."""
    kind, read = bag.kinds[topics[0]], islice(bag.messages(topics), MESSAGES_READ)
    rows = [(topic, fields_of(kind, message)) for topic, _, _, message in read]
    free = _ends_without_field(rows[0][1] if rows else {})
    key = _with_places(pattern, topics[0], free)
    ids = matching_topics(key, topics)
    # One id may be in the names of all topics.
    whole = name_template(topics[0], set(free) - ids[topics[0]].keys()) or topics[0]
    constants = matching_topics(whole, topics[:1]).get(topics[0], {})
    ids = {topic: {**places, **constants} for topic, places in ids.items()}
    # A template that also matches topics of other types is no key.
    stated = {key: constants} if len(matching_topics(key, bag.kinds)) == len(topics) else ids
    with raising(ImportTableError, f"{bag.path}: cannot be turned into a table", OSError, RecursionError):
        lines = (json.dumps(_unstamped(row) | ids[topic], allow_nan=False) for topic, row in rows)
        table.write_text("".join(f"{line}\n" for line in lines), "utf-8")
    guess = guess_table(bag.path, table, ids[topics[0]], {"data": "range"} if re.fullmatch(_NUMBERS, kind) else {})
    sections = [
        "\n".join([f"[topics.{json.dumps(topic)}]", *(f"{name} = {json.dumps(v)}" for name, v in values.items()), ""])
        for topic, values in stated.items()
    ]
    return replace(guess, text=f"{guess.text}\n# {len(topics)} topics of {kind}\n{''.join(sections)}\n")


def _unstamped(row: dict[str, Any]) -> dict[str, Any]:
    """Return a message without the stamp of its header, which is its time without a map."""
    header = row.get("header")
    return row | {"header": {**header, "stamp": {}}} if isinstance(header, dict) else row


def _grouped(topics: Sequence[str]) -> Iterator[tuple[str, list[str]]]:
    """Yield topics that differ by one or two numbers, or else words, and a format of their names; then the others."""
    braces, left = ([topic for topic in topics if ("{" in topic) == has] for has in (True, False))
    for value in (r"([0-9]+)", _WORD):
        alike: dict[tuple[str, ...], list[str]] = {}
        for topic in left:
            alike.setdefault(tuple(re.split(value, topic)[::2]), []).append(topic)
        for literals, some in alike.items():
            columns = [set(column) for column in zip(*(re.findall(value, topic) for topic in some), strict=True)]
            varying = [k for k, column in enumerate(columns) if len(column) > 1]
            both, words = [columns[k] for k in varying], {re.split("[^A-Za-z]", literals[k])[-1] for k in varying}
            # Number 1 of a tag is not number 1 of an anchor; among pairs of words some have a word in common.
            mixed = len(words) > 1 and both[0] & both[-1]
            apart = len(both) == 2 and value == _WORD and all(len(column) == len(some) for column in both)
            if not 1 <= len(varying) <= 2 or mixed or apart:
                continue
            parts = re.split(value, some[0])
            for n, k in enumerate(varying):
                parts[2 * k + 1] = f"{{{n}}}"
            left = [topic for topic in left if topic not in some]
            yield "".join(parts), some
    yield from ((topic, [topic]) for topic in (*left, *braces))


def _ends_without_field(row: Mapping[str, Any]) -> list[str]:
    """Return which of the two ids a message does not have itself; lists and arrays have a target in each element."""
    lists = [value for value in row.values() if isinstance(value, list)]
    elements = [one for value in lists for one in value[:1] if isinstance(one, dict)]
    named = {*named_columns(row), *(name for one in elements for name in named_columns(one))}
    arrays = [f"{name}.{k}" for name, value in row.items() if isinstance(value, dict) for k in value]
    if wide_columns(arrays, {}) or any({"id", "A", "a", "addr"} & one.keys() for one in elements):
        named.add("to_id")
    return [end for end in IDS if end not in named]


def _with_places(pattern: str, topic: str, free: Sequence[str]) -> str:
    """Return the template of topics, whose places are ids in `free`; `topic` is one of them."""
    parts = re.split(r"\{[01]\}", pattern)
    values = re.fullmatch("([^/]+?)".join(map(re.escape, parts)), topic)
    if len(parts) == 1 or values is None:
        return topic
    contexts = [part.rstrip("/").split("/")[-1] + value for part, value in zip(parts, values.groups(), strict=False)]
    ends = [next((end for end in IDS if re.search(_WORDS[end], text.lower())), "") for text in contexts]
    if len(ends) == 2:
        ends = list(IDS)[::-1] if ends[0] == "to_id" or ends[1] == "from_id" else list(IDS)
    elif ends[0] not in free:
        ends = list(free[-1:])
    if len(free) == 1:  # number 1 of a tag is not number 1 of the anchors in the messages
        pattern = re.sub(r"[A-Za-z]+\{", "{", pattern)
    return pattern.format(*(f"{{{end if end in free else '_'}}}" for end in [*ends, "_"]))
