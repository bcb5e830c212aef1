"""Names of columns as labs write them, English and German, and the columns of `NAMES` that they are."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable
from itertools import product
from typing import Final

from uwblink.importers.column_map import POSITIONS

OF_MESSAGES: Final = ("tx", "rx", "fpp", "rxp", "skew", "sts", "sequence", "message")

WORDS: Final = {
    "end": (
        r"(_(raw|ts|stamp|timestamp|time|ticks?|dtu|ps|ns|us|ms|s|sec|m|mm|cm|ft|in|meters?|metres?|"
        r"dbm|db|ppm))*"
    ),
    "id": r"(_?(id|addr|address|mac|name))?",
    "device": (
        r"(tag|node|device|dev|board|robot|agent|anchor|module|modul|radio|unit|uwb|id|addr|address|"
        r"mac|geraet|knoten)"
    ),
    "range": r"(range|dist|distance|abstand|distanz|entfernung|tof|time_?of_?flight)",
    "made": r"(raw|filt(er)?(ered)?|corrected|corr|kalman|smooth(ed)?)",
    "true": (
        r"(gt|true|truth|ground_?truth|ref|reference|nominal|mocap|vicon|actual|tape(_?measured?)?|"
        r"laser|soll|wahr(er)?|referenz)"
    ),
    "fpp": r"(fpp?|(fp|first_?path)_?(power|pwr|rssi|level|leistung)|first_?path|(rssi|power)_?(fp|first_?path))",
    "rxp": r"(rxp|rx_?(power|pwr|level)|rssi|total_?power|pr)",
    "skew": r"(skew|cfo|carrier|clock_?offset)",
    "sts": r"sts(_?(q|qual|quality))?(_?(idx|index))?",
    "of_time": r"((t|ts|time|stamp|timestamp|zeit)_)?",
    "from": r"(from|src|source|initiator|tag|my|sender|tx|requester|robot|rover|mobile|node_?a|id_?1)",
    "to": r"(to|dst|dest|destination|target|responder|anchor|neighbou?r|receiver|rx|beacon|node_?b|id_?2)",
}
"""Words that patterns are made of."""


def _place(name: str) -> str:
    """Return the pattern of a column of `POSITIONS`, for names such as `tag_x`, `anchor_pos_x_m`, `x_tag` and `x1`.

    A plain `x` is the initiator's, since the initiator moves if the other devices are called anchors.
    """
    end, axis = name.split("_")[:2]
    words, number = WORDS[end], 1 if end == "from" else 2
    true, place = r"((gt|true|truth|ground_?truth|mocap|ref)_?)?", r"(pos(ition)?|loc(ation)?|place|p)?"
    forms = [rf"{true}{words}_?{place}_?{axis}", rf"{true}{place}_?{axis}_?({words}|{number})", rf"p{number}_?{axis}"]
    forms += [rf"{true}{place}_?{axis}"] if end == "from" else []
    return "|".join(forms)


PATTERNS: Final = {
    "time_s": (
        r"(ros_?|host_?|unix_?|utc_?|mess_?)?"
        r"(time|timestamp|stamp|t|datetime|date(_?time)?|epoch|zeit|zeitstempel|uhrzeit|datum)(_(utc|iso))?"
    ),
    "from_id": r"(from|src|source|initiator|tag|my|sender|tx|requester|node_?a|quelle|von|id_?(from|von)|id_?1){id}",
    "to_id": (
        r"(to|dst|dest|destination|target|responder|anchor|neighbou?r|receiver|rx|node_?b|ziel|an|nach|anker|"
        r"empf(ae|a)nger|id_?(to|an|nach)|id_?2){id}"
    ),
    "tx1": r"{of_time}(tx_?1|t_?1|poll_?(tx|sent)|tx_?poll)",
    "rx1": r"{of_time}(rx_?1|t_?2|poll_?(rx|received)|rx_?poll)",
    "tx2": r"{of_time}(tx_?2|t_?3|resp(onse)?_?(tx|sent)|tx_?resp(onse)?)",
    "rx2": r"{of_time}(rx_?2|t_?4|resp(onse)?_?(rx|received)|rx_?resp(onse)?)",
    "tx3": r"{of_time}(tx_?3|t_?5|(final|report)_?(tx|sent)|tx_?(final|report))",
    "rx3": r"{of_time}(rx_?3|t_?6|(final|report)_?(rx|received)|rx_?(final|report))",
    "fpp1": r"{fpp}_?1",
    "fpp2": r"{fpp}_?2?",
    "rxp1": r"{rxp}_?1",
    "rxp2": r"{rxp}_?2?",
    "skew1": r"{skew}_?1",
    "skew2": r"{skew}_?2?",
    "sts1": r"{sts}_?1",
    "sts2": r"{sts}_?2?",
    "gt_range_m": r"{true}_?{range}?|{range}_?{true}",
    "range_m": r"({made}_?|device_?|measured?_?|uwb_?|est(imated)?_?)?{range}(_?{made})?",
    "sequence": r"(seq|sequence|exchange|laufnummer)(_?(no|num|nr|number|id))?",
    "message": r"(msg|message|frame|nachricht)(_?(no|num|nr|number|type|id))?",
    "tx": r"tx",
    "rx": r"rx",
    "fpp": r"{fpp}",
    "rxp": r"{rxp}",
    "skew": r"{skew}",
    "sts": r"{sts}",
} | {name: _place(name) for name in POSITIONS}
"""Patterns of the names of columns, in terms of `WORDS`."""

_OF_MESSAGE: Final = {"poll": 1, "resp": 2, "response": 2}
_AT_DEVICE: Final = {"resp": 1, "responder": 1, "target": 1, "anchor": 1, "init": 2, "initiator": 2, "tag": 2}


def plain_name(header: str) -> str:
    """Return a name in lower case without accents, its words joined by `_`: `first_path_1_dbm`."""
    bare = unicodedata.normalize("NFKD", header.replace("ß", "ss")).encode("ascii", "ignore").decode()
    return re.sub(r"[^a-z0-9]+", "_", bare.lower()).strip("_")


def _plain_names(headers: Iterable[str]) -> dict[str, str]:
    """Return plain names by header; powers and skews get the number of their message: `fp_power_init` is `fp_power_2`.

    `resp` means the responding device if another column names the initiator, else the response message.
    """
    level = "(?P<level>{fpp}|{rxp}|{skew}|{sts})".format_map(WORDS)
    end, whose = WORDS["end"], "|".join(sorted({*_OF_MESSAGE, *_AT_DEVICE}, key=len)[::-1])
    forms = (rf"{level}_(at_|of_)?(?P<whose>{whose})(?P<end>{end})", rf"(?P<whose>{whose})_{level}(?P<end>{end})")
    names = {header: plain_name(header) for header in headers}
    matches = {h: re.fullmatch(forms[0], name) or re.fullmatch(forms[1], name) for h, name in names.items()}
    ends = {match["whose"] for match in matches.values() if match}
    numbers = _AT_DEVICE | _OF_MESSAGE | ({"resp": 1, "response": 1} if ends & {"init", "initiator", "tag"} else {})
    return names | {h: f"{m['level']}_{numbers[m['whose']]}{m['end']}" for h, m in matches.items() if m}


def named_columns(headers: Iterable[str]) -> dict[str, str]:
    """Return the header of each recognised column; raw columns come before others, then earlier ones first."""
    listed = sorted(headers, key=lambda header: "raw" not in header.lower())
    called = _plain_names(listed)
    found = _ends(called)
    for ours, pattern in PATTERNS.items():
        whole = f"({pattern}){{end}}".format_map(WORDS)
        # Each column is used once, but for names of messages, which may repeat those of exchanges at this stage.
        taken = {header for name, header in found.items() if (name in OF_MESSAGES) == (ours in OF_MESSAGES)}
        free = (header for header in listed if listed.count(header) == 1 and header not in taken)
        if header := next((header for header in free if re.fullmatch(whole, called[header])), None):
            found[ours] = header
    return found


def _ends(called: dict[str, str]) -> dict[str, str]:
    """Return the columns of the two devices if their names differ by a letter, as `node_i` and `node_j`."""
    letters = (("a", "b"), ("i", "j"), ("1", "2"), ("0", "1"), ("one", "two"))
    for both, form in product(letters, ("{0}_?{1}", "{0}{2}_{1}", "{0}_?{1}{2}")):
        patterns = [form.format(WORDS["device"], letter, WORDS["id"]) for letter in both]
        ends = [[header for header, name in called.items() if re.fullmatch(one, name)] for one in patterns]
        stems = [{called[header][:2] for header in headers} for headers in ends]
        if all(len(headers) == 1 for headers in ends) and stems[0] == stems[1]:
            return {"from_id": ends[0][0], "to_id": ends[1][0]}
    return {}
