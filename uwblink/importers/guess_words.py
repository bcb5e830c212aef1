"""The words by which labs call columns of ours, English and German, as patterns of plain names."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping
from typing import Final

from uwblink.importers.column_map import POSITIONS

END: Final = r"(_(raw|ts|stamp|timestamp|time|ticks?|dtu|ps|ns|us|ms|s|sec|m|mm|cm|ft|in|meters?|metres?|dbm|db|ppm))*"
ID: Final = r"(_?(id|addr|address|mac|name))?"
DEVICE: Final = (
    r"(tag|node|device|dev|board|robot|agent|anchor|module|modul|radio|unit|uwb|id|addr|address|mac|geraet|knoten)"
)
TWO_ENDS: Final = (("a", "b"), ("i", "j"), ("1", "2"), ("0", "1"), ("one", "two"))
"""How the two ends of a range are told apart where both are called alike."""

_RANGE: Final = r"(range|dist|distance|abstand|distanz|entfernung)"
_TRUE: Final = (
    r"(gt|true|truth|ground_?truth|ref|reference|nominal|mocap|vicon|actual|tape(_?measured?)?|laser|"
    r"soll|wahr(er)?|referenz)"
)
_FPP: Final = r"(fpp?|(fp|first_?path)_?(power|pwr|rssi|level|leistung)|first_?path)"
_RXP: Final = r"(rxp|rx_?(power|pwr|level)|rssi|total_?power|pr)"
_SKEW: Final = r"(skew|cfo|carrier|clock_?offset)"
_LEVEL: Final = rf"({_FPP}|{_RXP}|{_SKEW})"
_OF_TIME: Final = r"((t|ts|time|stamp|timestamp|zeit)_)?"
_FROM: Final = r"(from|src|source|initiator|tag|my|sender|tx|requester|robot|rover|mobile|node_?a|id_?1)"
_TO: Final = r"(to|dst|dest|destination|target|responder|anchor|neighbou?r|receiver|rx|beacon|node_?b|id_?2)"


def _place(name: str) -> str:
    """Return what columns of one of `POSITIONS` are called: `tag_x`, `anchor_pos_x_m`, `x_tag`, `x1`; `x` is whose?

    A single `x` is that of the initiator, which moves where anchors are called so.
    """
    (end, axis), (number, words) = name.split("_")[:2], ("1", _FROM) if name.startswith("from") else ("2", _TO)
    true, place = r"((gt|true|truth|ground_?truth|mocap|ref)_?)?", r"(pos(ition)?|loc(ation)?|place|p)?"
    forms = [rf"{true}{words}_?{place}_?{axis}", rf"{true}{place}_?{axis}_?({words}|{number})", rf"p{number}_?{axis}"]
    forms += [rf"{true}{place}_?{axis}"] if end == "from" else []
    return "|".join(forms)


PATTERNS: Final = {
    "time_s": (
        r"(ros_?|host_?|unix_?|utc_?|mess_?)?"
        r"(time|timestamp|stamp|t|datetime|date(_?time)?|epoch|zeit|zeitstempel|uhrzeit|datum)(_(utc|iso))?"
    ),
    "from_id": rf"(from|src|source|initiator|tag|my|sender|tx|requester|node_?a|quelle|von|id_?(from|von)|id_?1){ID}",
    "to_id": (
        r"(to|dst|dest|destination|target|responder|anchor|neighbou?r|receiver|rx|node_?b|ziel|an|nach|anker|"
        rf"empf(ae|a)nger|id_?(to|an|nach)|id_?2){ID}"
    ),
    "tx1": _OF_TIME + r"(tx_?1|t_?1|poll_?(tx|sent)|tx_?poll)",
    "rx1": _OF_TIME + r"(rx_?1|t_?2|poll_?(rx|received)|rx_?poll)",
    "tx2": _OF_TIME + r"(tx_?2|t_?3|resp(onse)?_?(tx|sent)|tx_?resp(onse)?)",
    "rx2": _OF_TIME + r"(rx_?2|t_?4|resp(onse)?_?(rx|received)|rx_?resp(onse)?)",
    "tx3": _OF_TIME + r"(tx_?3|t_?5|(final|report)_?(tx|sent)|tx_?(final|report))",
    "rx3": _OF_TIME + r"(rx_?3|t_?6|(final|report)_?(rx|received)|rx_?(final|report))",
    "fpp1": rf"{_FPP}_?1",
    "fpp2": rf"{_FPP}_?2?",
    "rxp1": rf"{_RXP}_?1",
    "rxp2": rf"{_RXP}_?2?",
    "skew1": rf"{_SKEW}_?1",
    "skew2": rf"{_SKEW}_?2?",
    "gt_range_m": rf"{_TRUE}_?{_RANGE}?|{_RANGE}_?{_TRUE}",
    "range_m": rf"(device_?|measured?_?|uwb_?|est(imated)?_?)?{_RANGE}",
    "sequence": r"(seq|sequence|exchange|laufnummer)(_?(no|num|nr|number|id))?",
    "message": r"(msg|message|frame|nachricht)(_?(no|num|nr|number|type|id))?",
    "tx": r"tx",
    "rx": r"rx",
    "fpp": _FPP,
    "rxp": _RXP,
    "skew": _SKEW,
} | {name: _place(name) for name in POSITIONS}

_OF_MESSAGE: Final = {"poll": 1, "resp": 2, "response": 2}
_AT_DEVICE: Final = {"resp": 1, "responder": 1, "target": 1, "anchor": 1, "init": 2, "initiator": 2, "tag": 2}
_WHOSE: Final = "|".join(sorted({*_OF_MESSAGE, *_AT_DEVICE}, key=len, reverse=True))
_LEVEL_OF: Final = re.compile(rf"(?P<level>{_LEVEL})_(at_|of_)?(?P<whose>{_WHOSE})(?P<end>{END})")
_OF_LEVEL: Final = re.compile(rf"(?P<whose>{_WHOSE})_(?P<level>{_LEVEL})(?P<end>{END})")


def plain(header: str) -> str:
    """Return a name in small letters without accents, words joined by `_`: `first_path_1_dbm`."""
    bare = unicodedata.normalize("NFKD", header.replace("ß", "ss")).encode("ascii", "ignore").decode()
    return re.sub(r"[^a-z0-9]+", "_", bare.lower()).strip("_")


def numbered(names: Mapping[str, str]) -> dict[str, str]:
    """Return plain names in which powers and skews have the number of their message: `fp_power_init` is `fp_power_2`.

    `names` are plain ones by header. `resp` is the device where another column is of the initiator, else the message.
    """
    found = {header: _LEVEL_OF.fullmatch(name) or _OF_LEVEL.fullmatch(name) for header, name in names.items()}
    whose = {match["whose"] for match in found.values() if match}
    numbers = _AT_DEVICE | _OF_MESSAGE | ({"resp": 1, "response": 1} if whose & {"init", "initiator", "tag"} else {})
    return {
        header: f"{match['level']}_{numbers[match['whose']]}{match['end']}" if (match := found[header]) else name
        for header, name in names.items()
    }
