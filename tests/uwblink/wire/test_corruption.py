"""A stream with damaged bytes: every intact message comes through, and nothing is made up."""

import numpy as np
import pytest

from uwblink.wire import messages as m
from uwblink.wire.codec import Decoder, encode
from uwblink.wire.messages import REPORTS


def stream_of(count, rng):
    """Random reports of the kinds that boards send while ranging."""

    def number(scale):
        return round(float(rng.normal(0, scale)), 4)

    def stamps(n):
        return rng.integers(0, 2**32, n).tolist()

    kinds = [
        lambda: m.RangeReport(int(rng.integers(0, 255)), number(5), *stamps(6), *[number(50) for _ in range(4)]),
        lambda: m.TargetRangeReport(int(rng.integers(0, 255)), number(5), *stamps(6), *[number(50) for _ in range(4)]),
        lambda: m.Overheard(1, 2, *stamps(9), *[number(50) for _ in range(10)]),
        lambda: m.BroadcastReceived(rng.integers(0, 256, int(rng.integers(0, 92))).astype(np.uint8).tobytes()),
    ]
    return [kinds[k]() for k in rng.integers(0, len(kinds), count)]


@pytest.mark.parametrize("seed", range(2))
def test_one_percent_of_damaged_bytes(seed):
    rng = np.random.default_rng(seed)
    sent = stream_of(2000, rng)
    texts = [encode(message) for message in sent]
    whole = np.frombuffer(b"".join(texts), dtype=np.uint8)
    hit = rng.random(len(whole)) < 0.01
    damaged = np.where(hit, rng.integers(0, 256, len(whole)), whole).astype(np.uint8)
    changed = damaged != whole
    ends = np.cumsum([len(t) for t in texts])
    touched = np.array([changed[e - len(t) : e].any() for e, t in zip(ends, texts, strict=True)])
    assert 0.5 < touched.mean() < 0.9
    decoder = Decoder(REPORTS)
    data, events = damaged.tobytes(), []
    for at in range(0, len(data), 333):
        events += decoder.feed(data[at : at + 333])
    events += decoder.finish()
    found = [e for e in events if isinstance(e, m.Message)]
    intact = [message for message, bad in zip(sent, touched, strict=True) if not bad]
    # The intact ones appear, all of them, in their order ...
    place = -1
    for message in intact:
        place = found.index(message, place + 1)
    # ... and there are no more messages than places where one was sent: what else decodes is a sent message whose
    # damage hit digits only, which no decoder can see, for the wire has no checksum.
    assert len(found) <= len(sent)
    altered = len(found) - len(intact)
    assert altered < 0.5 * touched.sum()


def test_random_bytes_make_no_message():
    decoder = Decoder(REPORTS)
    events = decoder.feed(np.random.default_rng(7).bytes(200_000)) + decoder.finish()
    assert {type(event) for event in events} == {m.Skipped}
    assert (decoder.messages, decoder.skipped_bytes) == (0, 200_000)
