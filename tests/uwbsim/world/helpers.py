"""Measurements that several tests of the world share."""

import numpy as np

import uwbsim
from uwblink import Board
from uwblink.wire.codec import Decoder
from uwblink.wire.messages import REPORTS, Overheard


def served(world):
    """Range once from tag 1 to tag 2; return the output of the initiator and of the listener, tag 3."""
    ports = uwbsim.VirtualPorts(world)
    Board(ports.port(3)).set_passive(True)
    report = Board(ports.port(1)).range(2)
    ports.bench.advance(int(ports.bench.env.now) + 50_000_000)
    heard = b"".join(data for _, tag, data in ports.transfers if tag == 3)
    (overheard,) = (event for event in Decoder(REPORTS).feed(heard) if isinstance(event, Overheard))
    return report, overheard


def autocorrelation(values, lag):
    centred = values - values.mean()
    return np.mean(centred[lag:] * centred[:-lag]) / np.mean(centred**2)
