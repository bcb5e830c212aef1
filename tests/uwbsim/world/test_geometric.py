"""The channel from geometry: images, powers, shadows, persistence, and the same for all who receive."""

import numpy as np
import pytest
from scipy.optimize import minimize

import uwbsim
from tests.uwbsim.world.helpers import autocorrelation
from uwblink import raw_range
from uwbsim.world.clocks import SUBTICKS_PER_SECOND
from uwbsim.world.world import SampledWorld, World

ROOM = {"min_m": [0.0, 0.0, 0.0], "max_m": [8.0, 6.0, 3.0], "roughness_mm": 0.0}
A, B = (1.0, 2.0, 1.0), (5.0, 3.5, 1.6)
WAVELENGTH_M = 299_702_547 / 3993.6e6
ZERO, ONE = np.array([0]), np.array([1])


def scenario(*, places=(A, B), motion=None, scatterers=0, stamp_noise=False, **more):
    quiet = {"rx_noise_ps": 0.0, "power_noise_db": 0.0, "quantize": False, "first_path_at_1m_dbm": -72.0}
    model = {"model": "geometric", "scatterers": scatterers, "stamp_noise": stamp_noise}
    bodies = [{"name": f"b{k}", "motion": {"model": "static", "position_m": list(p)}} for k, p in enumerate(places)]
    if motion:
        bodies[0]["motion"] = motion
    base = {
        "run": {"duration_s": 1.0, "seed": 2},
        "ranging": {"rate_hz": 40.0, "pairs": [[1, 2]]} | more.pop("ranging", {}),
        "radio": quiet | {"multipath": model} | more.pop("radio", {}),
        "bodies": bodies + more.pop("bodies", []),
        "tags": [{"id": k + 1, "body": f"b{k}"} for k in range(len(places))],
    }
    return uwbsim.load(base | more)


def world_paths(world, time_s=0.5):
    """Lengths in metres and complex amplitudes of all paths there are, in order of length."""
    found = World(world).responses.paths((ZERO, ONE), np.array([time_s]))
    there = np.abs(found.amplitude[0]) > 1e-12
    length = found.detour_m[0][there] + np.linalg.norm(np.subtract(A, B))
    order = np.argsort(length)
    return length[order], found.amplitude[0][there][order]


def link(world, time_s=0.5):
    now = np.array([round(time_s * SUBTICKS_PER_SECOND)])
    return World(world).link(ZERO, ONE, now)


def test_noiseless_stays_exact():
    """In free space the response has one path, and ranges are what they are without any model."""
    for distance in (0.3, 4.0, 60.0):
        flight = uwbsim.simulate(scenario(places=((0.0, 0.0, 1.0), (distance, 0.0, 1.0))))
        plain = uwbsim.simulate(scenario(places=((0.0, 0.0, 1.0), (distance, 0.0, 1.0)), radio={"multipath": None}))
        np.testing.assert_array_equal(raw_range(flight.exchanges), raw_range(plain.exchanges))
        np.testing.assert_allclose(flight.exchanges.fpp1_dbm, plain.exchanges.fpp1_dbm, atol=1e-9)


def test_total_power_in_free_space_is_that_of_friis():
    for distance in (0.5, 4.0, 30.0):
        found = link(scenario(places=((0.0, 0.0, 1.0), (distance, 0.0, 1.0)), radio={"antenna": "dipole"}))
        assert found.total_dbm[0] == pytest.approx(-72 - 20 * np.log10(distance) + 2 * 1.76, abs=0.1)


def shortest_by(axis, at):
    """The shortest way by a wall, found by moving the point of reflection: Fermat's principle, no images."""
    others = [k for k in range(3) if k != axis]

    def length(spot):
        point = np.zeros(3)
        point[axis], point[others] = at, spot
        return np.linalg.norm(point - A) + np.linalg.norm(point - B)

    return minimize(length, np.zeros(2), method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-10}).fun


def test_reflections_take_the_shortest_ways_by_the_walls():
    length, _ = world_paths(scenario(room=ROOM))
    walls = [shortest_by(axis, at) for axis, size in enumerate((8.0, 6.0, 3.0)) for at in (0.0, size)]
    np.testing.assert_allclose(length, sorted([np.linalg.norm(np.subtract(A, B)), *walls]), atol=1e-6)


def test_the_reflection_off_the_floor_has_fresnels_loss_and_the_antennas_gains():
    """Two upright dipoles: polarised in the plane of incidence, in phase off metal, less by |R| off glass."""
    for material, epsilon in (("metal", -1e12), ("glass", (2.5 - 1j * 40 / 8.686 * WAVELENGTH_M / 2 / np.pi) ** 2)):
        walls = ROOM | {"material": {"loss_db_per_m": 0.0, "index": 1.0}, "floor": material}
        length, amplitude = world_paths(scenario(room=walls, radio={"antenna": "dipole"}))
        assert len(length) == 2, "walls of air give nothing back"
        flat = np.hypot(4.0, 1.5)
        sine, cosine = (v / np.hypot(flat, 2.6) for v in (flat, 2.6))
        root = np.sqrt(epsilon - sine**2 + 0j)
        reflection = (epsilon * cosine - root) / (epsilon * cosine + root) if material != "metal" else 1.0
        expected = 10 ** (-72 / 20) / length[1] * 10 ** (2 * 1.76 / 20) * sine**2 * reflection
        turned = amplitude[1] * np.exp(2j * np.pi * length[1] / WAVELENGTH_M)
        # The pattern of antennas is tabulated over directions, a degree apart: 0.2 dB.
        assert abs(turned - expected) < 0.025 * abs(expected)


def test_an_upright_dipole_sees_a_metal_wall_turn_its_field_round():
    walls = ROOM | {"material": "metal", "floor": {"loss_db_per_m": 0}, "ceiling": {"loss_db_per_m": 0}}
    length, amplitude = world_paths(scenario(places=(A, (5.0, 3.5, 1.0)), room=walls, radio={"antenna": "dipole"}))
    length = length - np.linalg.norm(np.subtract(A, B)) + np.hypot(4.0, 1.5)
    turned = amplitude * np.exp(2j * np.pi * length / WAVELENGTH_M)
    np.testing.assert_allclose(turned[1:] * length[1:] / (turned[0] * length[0]), -1, atol=0.01)


def test_a_mirror_on_an_obstacle_is_as_large_as_its_face():
    """A metal plate beside the link reflects where the image is seen in it, half at its edge, and not beyond."""
    strength = []
    for end in (8.0, 3.0, 1.0):
        plate = {"min_m": [-3.0, 4.0, -3.0], "max_m": [end, 4.1, 6.0], "material": "metal", "roughness_mm": 0.0}
        found = scenario(places=((1.0, 2.0, 1.5), (5.0, 2.0, 1.5)), obstacles=[plate])
        paths = World(found).responses.paths((ZERO, ONE), np.zeros(1))
        later = np.argmin(np.abs(paths.detour_m[0] - (np.hypot(4, 4) - 4)))
        strength.append(abs(paths.amplitude[0][later]) * np.hypot(4, 4) / 10 ** (-72 / 20))
    assert strength[0] == pytest.approx(1.0, abs=0.1)
    assert strength[1] == pytest.approx(0.5, abs=0.05)
    assert strength[2] < 0.1


def test_a_blocked_link_ranges_by_the_reflection_and_shows_it_in_its_powers():
    """A metal plate hides the direct way, not the way by the metal ceiling: its detour is known by hand."""
    walls = ROOM | {"material": {"loss_db_per_m": 0}, "ceiling": "metal"}
    plate = {"min_m": [2.95, -3.0, -9.0], "max_m": [3.0, 9.0, 2.0], "material": "metal"}
    places = ((1.0, 2.0, 1.0), (5.0, 2.0, 1.0))
    free, blocked = (scenario(places=places, room=walls, obstacles=o) for o in ([], [plate]))
    detour = np.hypot(4.0, 4.0) - 4.0
    assert link(free).excess_m[0] == pytest.approx(0.0, abs=0.03)
    found = link(blocked)
    assert found.excess_m[0] == pytest.approx(detour, abs=0.06)
    flight = uwbsim.simulate(blocked)
    np.testing.assert_allclose(raw_range(flight.exchanges) - flight.truth_m, found.excess_m[0], atol=0.006)


def test_bodies_stand_in_each_others_way_and_in_their_own():
    shadow = {"semi_axes_m": [0.3, 0.3, 0.3], "loss_db_per_m": 60.0}
    post = {"name": "post", "motion": {"model": "static", "position_m": [3.0, 2.75, 1.3]}, "shadow": shadow}
    free, shaded = (link(scenario(bodies=bodies)) for bodies in ([], [post]))
    assert 3 < free.power_dbm[0] - shaded.power_dbm[0] < 25
    frame = {"semi_axes_m": [0.2, 0.2, 0.05], "centre_m": [0.25, 0.1, 0.04], "loss_db_per_m": 60.0}
    own = scenario()
    carried = uwbsim.load(own.model_dump(mode="json"), {"bodies.0.shadow": frame})
    assert 1 < free.power_dbm[0] - link(carried).power_dbm[0] < 25


SLOW = {"model": "waypoints", "points_m": [[1.0, 2.0, 1.0], [3.0, 2.4, 1.2]], "speed_mps": 0.2}
CLUTTER = {"room": ROOM, "scatterers": 32}
DESK = {"min_m": [3.9, 0.5, 0.0], "max_m": [4.1, 5.5, 1.9], "material": "metal"}


@pytest.fixture(scope="module")
def slow_flight():
    """Three pairs in a room, of which one tag moves at 0.2 m/s, ten exchanges a second each."""
    moving = scenario(
        places=(A, B, (6.5, 1.0, 0.8), (6.8, 5.2, 2.1)),
        motion=SLOW,
        obstacles=[DESK],
        run={"duration_s": 9.0, "seed": 4},
        ranging={"rate_hz": 300.0, "pairs": [[1, 2], [1, 3], [1, 4]], "get_cir": True, "response_delay_uus": 500},
        **CLUTTER,
    )
    return uwbsim.simulate(moving)


def of_pair(flight, target):
    rows = flight.exchanges.target == target
    return rows, (raw_range(flight.exchanges) - flight.truth_m)[rows]


def test_excess_lasts_as_long_as_geometry_does(slow_flight):
    """2 mm on, waves add up as before; a second and 20 cm on, nearly three wavelengths, they do not."""
    for target in (2, 3, 4):
        excess = of_pair(slow_flight, target)[1]
        assert autocorrelation(excess, 1) > 0.8
        assert autocorrelation(excess, 1) > autocorrelation(excess, 100) + 0.2


def test_excess_shows_in_powers_and_responses(slow_flight):
    """The later the first path seems, the more of the power comes after it, in what boards print."""
    rows, _ = of_pair(slow_flight, 2)
    late, rise = [], []
    for row in (row for row in slow_flight.cirs if row.target == 2):
        taps = np.array(row.magnitudes, dtype=float)
        first = int(row.first_path_index)
        late.append(10 * np.log10(np.sum(taps[first - 3 : first + 60] ** 2) / np.sum(taps[first + 1 : first + 4] ** 2)))
        rise.append(np.argmax(taps) - row.first_path_index)
    # The response is that of the last frame, and the range that of all three.
    assert np.corrcoef(late, slow_flight.exchanges.fpp2_dbm[rows])[0, 1] < -0.5
    assert np.std(rise) > 1


def test_responses_have_the_first_path_where_the_stamp_is_with_its_power(slow_flight):
    powers = []
    for row in slow_flight.cirs:
        taps = np.array(row.magnitudes, dtype=float)[int(row.first_path_index) + np.arange(1, 4)]
        powers.append(10 * np.log10(np.sum(taps**2) / 118**2) - 121.74)
    # The firmware's estimate of magnitudes, noise, and where the taps lie scatter it.
    difference = np.array(powers) - slow_flight.exchanges.fpp2_dbm
    assert np.median(difference) == pytest.approx(0.3, abs=0.5)
    assert np.quantile(np.abs(difference - np.median(difference)), 0.8) < 1.0


def test_scatterers_stay_where_they_are_and_more_of_them_leave_the_first_there():
    few, many = (World(scenario(room=ROOM, scatterers=n)).responses.scatterers for n in (5, 40))
    for name in ("place_m", "extra_m", "gain"):
        np.testing.assert_array_equal(getattr(few, name), getattr(many, name)[:5])
    assert np.all((many.place_m >= 0) & (many.place_m <= np.array([8.0, 6.0, 3.0])))


def test_what_is_asked_one_at_a_time_and_all_at_once_is_the_same_draw_for_draw():
    """While a tag moves: flights ask for many links, served boards for one sender at an instant."""
    world = World(scenario(places=(A, B, (6.5, 1.0, 0.8)), motion=SLOW, **CLUTTER))
    time = (np.linspace(0.0, 0.9, 37) * SUBTICKS_PER_SECOND).astype(np.int64)
    sampled = SampledWorld(World(world.scenario))
    for target in (1, 2):
        many = world.link(np.zeros(37, dtype=np.int64), np.full(37, target), time)
        for name in ("excess_m", "power_dbm", "total_dbm", "noise_s"):
            one_by_one = [getattr(sampled.from_sender(0, int(t)), name)[target] for t in time]
            np.testing.assert_allclose(one_by_one, getattr(many, name), rtol=1e-9, atol=1e-12)
        assert np.ptp(many.excess_m) > 0


def test_links_are_the_same_both_ways_but_for_who_sends_stronger():
    thin = {"min_m": [2.0, 2.4, 0.0], "max_m": [2.2, 4.0, 2.5], "material": "drywall"}
    world = World(scenario(obstacles=[thin], radio={"antenna": "dipole"}, **CLUTTER))
    now = np.array([SUBTICKS_PER_SECOND // 2])
    there, back = world.link(ZERO, ONE, now), world.link(ONE, ZERO, now)
    assert there.power_dbm[0] == back.power_dbm[0]
    loud = world.scenario.model_copy(
        update={"tags": (world.scenario.tags[0].model_copy(update={"tx_power_db": 3.0}), *world.scenario.tags[1:])}
    )
    there, back = World(loud).link(ZERO, ONE, now), World(loud).link(ONE, ZERO, now)
    assert there.power_dbm[0] - back.power_dbm[0] == pytest.approx(3.0, abs=0.2)
    assert there.total_dbm[0] - back.total_dbm[0] == pytest.approx(3.0, abs=1e-9)


def test_weak_first_paths_have_noisier_stamps():
    near, far = (scenario(places=((0.0, 0.0, 1.0), (d, 0.0, 1.0)), stamp_noise=True) for d in (2.0, 40.0))
    spread = [np.std(raw_range(uwbsim.simulate(world).exchanges)) for world in (near, far)]
    said = [link(world).noise_s[0] for world in (near, far)]
    assert said[1] > 1.2 * said[0]
    assert spread[1] / spread[0] == pytest.approx(said[1] / said[0], rel=0.3)


@pytest.mark.parametrize(
    ("more", "fragment"),
    [
        ({"room": ROOM | {"reflection_loss_db": 6.0}}, "room.reflection_loss_db: found 6, but in the geometric model"),
        ({"scatterers": 3}, "radio.multipath.scatterers: found 3 and no room"),
        ({"room": ROOM | {"floor": "cheese"}}, "room.floor.*cheese.*known are air"),
    ],
)
def test_what_cannot_be_is_refused(more, fragment):
    with pytest.raises(uwbsim.ScenarioError, match=fragment):
        scenario(**more)
