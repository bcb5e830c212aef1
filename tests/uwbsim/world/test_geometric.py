"""The channel from geometry: images, powers, shadows, persistence, and equality for all receivers."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import minimize

import uwbsim
from tests.uwbsim.world.test_channel import ONE, ZERO, autocorrelation, by_pair, first_path_dbm, link
from tests.uwbsim.world.test_channel import scenario as still
from uwblink import raw_range
from uwbsim.scenario.bodies import Material, Obstacle, Shadow
from uwbsim.world.clocks import SUBTICKS_PER_SECOND
from uwbsim.world.diffraction import (
    blocked_fraction,
    body_gain,
    box_chords_m,
    box_loss,
    boxes_blocked,
    edge_gain,
    ellipsoid_chord_m,
    fresnel,
    permittivity,
    roughness_factor,
)
from uwbsim.world.world import SampledWorld, World

ROOM = {"min_m": [0.0, 0.0, 0.0], "max_m": [8.0, 6.0, 3.0], "roughness_mm": 0.0}
A, B = (1.0, 2.0, 1.0), (5.0, 3.5, 1.6)
WAVELENGTH_M = 299_702_547 / 3993.6e6


def scenario(*, places=(A, B), motion=None, scatterers=0, stamp_noise=False, radio=None, **more):
    multipath = {"model": "geometric", "scatterers": scatterers, "stamp_noise": stamp_noise}
    radio = {"first_path_at_1m_dbm": -72.0, "multipath": multipath} | (radio or {})
    return still(places, (), {"bodies.0.motion": motion} if motion else {}, radio=radio, **more)


def world_paths(world):
    """Return lengths in metres and complex amplitudes of all paths, in order of length."""
    found = World(world).responses.paths((ZERO, ONE), np.array([0.5]))
    there = np.abs(found.amplitude[0]) > 1e-12
    length = found.detour_m[0][there] + np.linalg.norm(np.subtract(A, B))
    order = np.argsort(length)
    return length[order], found.amplitude[0][there][order]


def test_noiseless_stays_exact():
    """In free space the response has one path, and ranges are those without a model."""
    for distance in (0.3, 4.0, 30.0):
        flight = uwbsim.simulate(scenario(places=((0.0, 0.0, 1.0), (distance, 0.0, 1.0))))
        plain = uwbsim.simulate(scenario(places=((0.0, 0.0, 1.0), (distance, 0.0, 1.0)), radio={"multipath": None}))
        np.testing.assert_array_equal(raw_range(flight.exchanges), raw_range(plain.exchanges))
        np.testing.assert_allclose(flight.exchanges.fpp1_dbm, plain.exchanges.fpp1_dbm, atol=1e-9)


def test_total_power_in_free_space_is_that_of_friis():
    for distance in (0.5, 4.0, 30.0):
        found = link(scenario(places=((0.0, 0.0, 1.0), (distance, 0.0, 1.0)), radio={"antenna": "dipole"}))
        assert found.total_dbm[0] == pytest.approx(-72 - 20 * np.log10(distance) + 2 * 1.76, abs=0.1)


def shortest_by(axis, at):
    """Return the shortest path by a wall, by moving the point of reflection: Fermat's principle, without images."""
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
    """Two upright dipoles: polarised in the plane of incidence, in phase off metal, reduced by |R| off glass."""
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


def test_a_metal_wall_inverts_the_field_of_an_upright_dipole():
    walls = ROOM | {"material": "metal", "floor": {"loss_db_per_m": 0}, "ceiling": {"loss_db_per_m": 0}}
    length, amplitude = world_paths(scenario(places=(A, (5.0, 3.5, 1.0)), room=walls, radio={"antenna": "dipole"}))
    length = length - np.linalg.norm(np.subtract(A, B)) + np.hypot(4.0, 1.5)
    turned = amplitude * np.exp(2j * np.pi * length / WAVELENGTH_M)
    np.testing.assert_allclose(turned[1:] * length[1:] / (turned[0] * length[0]), -1, atol=0.01)


def test_a_mirror_on_an_obstacle_is_as_large_as_its_face():
    """A metal plate beside the link reflects where the image is visible in it, half at its edge, and not beyond."""
    strength = []
    for end in (8.0, 3.0, 1.0):
        plate = {"min_m": [-3.0, 4.0, -3.0], "max_m": [end, 4.1, 6.0], "material": "metal", "roughness_mm": 0.0}
        found = scenario(places=((1.0, 2.0, 1.5), (5.0, 2.0, 1.5)), obstacles=[plate])
        paths = World(found).responses.paths((ZERO, ONE), np.zeros(1))
        later = np.argmin(np.abs(paths.detour_m[0] - (np.hypot(4, 4) - 4)))
        strength.append(abs(paths.amplitude[0][later]) * np.hypot(4, 4) / 10 ** (-72 / 20))
    assert (strength[0], strength[1]) == (pytest.approx(1.0, abs=0.1), pytest.approx(0.5, abs=0.05))
    assert strength[2] < 0.1


def test_a_blocked_link_ranges_by_the_reflection_and_shows_it_in_its_powers():
    """A metal plate blocks the direct path, not the path by the metal ceiling: its detour is known by hand."""
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


def test_bodies_block_paths_of_others_and_their_own():
    shadow = {"semi_axes_m": [0.3, 0.3, 0.3], "loss_db_per_m": 60.0}
    post = {"name": "post", "motion": {"model": "static", "position_m": [3.0, 2.75, 1.3]}, "shadow": shadow}
    free, shaded = (link(scenario(bodies=bodies)) for bodies in ([], [post]))
    assert 3 < free.power_dbm[0] - shaded.power_dbm[0] < 25
    frame = {"semi_axes_m": [0.2, 0.2, 0.05], "centre_m": [0.25, 0.1, 0.04], "loss_db_per_m": 60.0}
    carried = uwbsim.load(scenario().model_dump(mode="json"), {"bodies.0.shadow": frame})
    assert 1 < free.power_dbm[0] - link(carried).power_dbm[0] < 25


SLOW = {"model": "waypoints", "points_m": [[1.0, 2.0, 1.0], [3.0, 2.4, 1.2]], "speed_mps": 0.2}
CLUTTER = {"room": ROOM, "scatterers": 32}


@pytest.fixture(scope="module")
def slow_flight():
    """Three pairs in a room, in which one tag moves at 0.2 m/s, with ten exchanges a second each."""
    moving = scenario(
        places=(A, B, (6.5, 1.0, 0.8), (6.8, 5.2, 2.1)),
        motion=SLOW,
        obstacles=[{"min_m": [3.9, 0.5, 0.0], "max_m": [4.1, 5.5, 1.9], "material": "metal"}],
        run={"duration_s": 9.0, "seed": 4},
        ranging={"rate_hz": 300.0, "pairs": [[1, 2], [1, 3], [1, 4]], "get_cir": True, "response_delay_uus": 500},
        **CLUTTER,
    )
    return uwbsim.simulate(moving)


def test_excess_lasts_as_long_as_geometry_does(slow_flight):
    """After 2 mm, waves add as before; after a second and 20 cm, nearly three wavelengths, they do not."""
    for target in (2, 3, 4):
        excess = by_pair(slow_flight, (1, target))[1]
        assert autocorrelation(excess, 1) > 0.8
        assert autocorrelation(excess, 1) > autocorrelation(excess, 100) + 0.2


def test_excess_shows_in_powers_and_responses(slow_flight):
    """The later the first path seems to be, the more of the power comes after it, in the output of boards."""
    rows, _ = by_pair(slow_flight, (1, 2))
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
    # The firmware's estimate of magnitudes, noise, and the positions of the taps cause scatter.
    difference = np.array([first_path_dbm(row) for row in slow_flight.cirs]) - slow_flight.exchanges.fpp2_dbm
    assert np.median(difference) == pytest.approx(0.3, abs=0.5)
    assert np.quantile(np.abs(difference - np.median(difference)), 0.8) < 1.0


def test_scatterers_stay_where_they_are_and_more_of_them_leave_the_first_there():
    few, many = (World(scenario(room=ROOM, scatterers=n)).responses.scatterers for n in (5, 40))
    for name in ("place_m", "extra_m", "gain"):
        np.testing.assert_array_equal(getattr(few, name), getattr(many, name)[:5])
    assert np.all((many.place_m >= 0) & (many.place_m <= np.array([8.0, 6.0, 3.0])))


def test_links_computed_singly_and_together_have_the_same_draws():
    """While a tag moves: flights ask for many links, served boards for one sender at a time."""
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


# Waves at boxes, bodies and faces: chords by sampling, shadows by the Fresnel integral, reflections by Snell's law.


RNG = np.random.default_rng(3)
BOX = Obstacle(min_m=(0, 0, 0), max_m=(1, 2, 3), material="concrete")


def sampled(inside, a, b, n=20_001):
    points = a[:, None, :] + ((np.arange(n) + 0.5) / n)[None, :, None] * (b - a)[:, None, :]
    return inside(points).mean(axis=1) * np.linalg.norm(b - a, axis=1)


def test_chords_of_boxes_are_what_sampling_finds():
    along_x = [[[x, y, 1.0] for y in (1.0, 2.5, -0.001)] for x in (-1.0, 3.0)]
    a, b = np.concatenate([RNG.uniform(-2, 4, (2, 50, 3)), along_x], axis=1)
    found = box_chords_m([BOX], a, b)[:, 0]
    expected = sampled(lambda p: np.all((p >= BOX.min_m) & (p <= BOX.max_m), axis=-1), a, b)
    np.testing.assert_allclose(found, expected, atol=2e-3)
    assert np.count_nonzero(found) > 5


def test_chords_of_ellipsoids_are_what_sampling_finds():
    shadow = Shadow(semi_axes_m=(0.5, 1.0, 0.3), centre_m=(0.1, 0.0, -0.2))
    a, b = RNG.uniform(-1, 1, (2, 50, 3))
    scale, centre = np.array(shadow.semi_axes_m), np.array(shadow.centre_m)
    expected = sampled(lambda p: np.sum(((p - centre) / scale) ** 2, axis=-1) <= 1, a, b)
    np.testing.assert_allclose(ellipsoid_chord_m(shadow, a, b), expected, atol=2e-3)


def test_loss_and_excess_add_up_over_obstacles():
    own = Obstacle(min_m=(2, 0, 0), max_m=(2.5, 2, 3), material={"loss_db_per_m": 10.0, "index": 3.0})
    loss, excess = box_loss([BOX, own], np.array([[-1.0, 1.0, 1.0]]), np.array([[4.0, 1.0, 1.0]]))
    assert [loss[0], excess[0]] == pytest.approx([80.0 * 1.0 + 10.0 * 0.5, 1.4 * 1.0 + 2.0 * 0.5])


def knife_edge_db(nu):
    """Return |1/(1 - j) times the integral from nu of exp(-j pi u^2/2)|: half of the whole minus the part up to nu."""
    across = 0.5 - quad(lambda u: np.cos(np.pi * u * u / 2), 0, nu, limit=2000)[0]
    along = 0.5 - quad(lambda u: np.sin(np.pi * u * u / 2), 0, nu, limit=2000)[0]
    return -20 * np.log10(np.hypot(across, along) / np.sqrt(2))


def itu_db(nu):
    """Equation 31 of the recommendation."""
    return 6.9 + 20 * np.log10(np.sqrt((nu - 0.1) ** 2 + 1) + nu - 0.1)


@pytest.mark.parametrize("nu", [-2.0, -0.7, 0.0, 0.4, 1.0, 2.4, 5.0])
def test_what_a_half_plane_leaves_is_fresnels_integral(nu):
    assert -20 * np.log10(abs(1 - blocked_fraction(np.array([nu]))[0])) == pytest.approx(knife_edge_db(nu), abs=0.02)


@pytest.mark.parametrize("nu", [-0.5, 0.0, 1.0, 2.4, 10.0])
def test_the_approximation_for_bodies_is_that_of_the_itu(nu):
    assert -20 * np.log10(edge_gain(np.array([nu]))[0]) == pytest.approx(itu_db(nu), abs=1e-9)
    assert itu_db(nu) == pytest.approx(knife_edge_db(nu), abs=0.8)


@pytest.mark.parametrize("above_m", [-0.5, -0.1, 0.0, 0.05, 0.2, 0.6])
def test_a_long_thin_wall_is_a_knife_edge(above_m):
    """Its upper edge is this high above the line of sight, 2 m from one end and 3 m from the other."""
    wall = Obstacle(min_m=(1.999, -50, -50), max_m=(2.001, 50, above_m), material="metal")
    cover, edge = boxes_blocked([wall], np.array([[0.0, 0, 0]]), np.array([[5.0, 0, 0]]))
    nu = above_m * np.sqrt(2 * 5 / (WAVELENGTH_M * 2 * 3))
    assert edge[0, 0] == pytest.approx(nu, rel=1e-3, abs=1e-6)
    assert -20 * np.log10(abs(1 - cover[0, 0])) == pytest.approx(knife_edge_db(nu), abs=0.6)
    if nu > -0.7:
        assert -20 * np.log10(abs(1 - cover[0, 0])) == pytest.approx(itu_db(nu), abs=1.0)


BODY = Shadow(semi_axes_m=(0.3, 0.3, 0.3), loss_db_per_m=1000.0)


def past(body, height_m=0.0, begin_m=-2.0):
    """Return the share of the field that passes a body at the origin, over a path along x to 3 m behind it."""
    return body_gain(body, np.array([[begin_m, 0, height_m]]), np.array([[3.0, 0, height_m]]))[0]


def past_db(height_m):
    return -20 * np.log10(past(BODY, height_m))


def test_bodies_have_soft_edges():
    """A sphere covers a vertical and a horizontal strip, each with up to two edges; the rest passes."""
    scale = np.sqrt(2 * 5 / (WAVELENGTH_M * 2 * 3))
    across = 1 - 2 * 10 ** (-itu_db(0.3 * scale) / 20)
    for height in (0.0, 0.15, 0.29):
        upright = 1 - np.sum(10 ** (-itu_db((0.3 + np.array([-1, 1]) * height) * scale) / 20))
        assert past_db(height) == pytest.approx(-20 * np.log10(1 - upright * across), abs=0.05)
    losses = [past_db(height) for height in np.linspace(0.0, 0.6, 61)]
    assert max(-np.diff(losses)) < 0.7, "no step over a centimetre"
    assert losses[0] > 5
    assert losses[-1] == 0


def test_bodies_are_walls_with_two_edges_or_weaken_a_path_or_lie_beside_it():
    tall = Shadow(semi_axes_m=(0.3, 0.3, 30.0), loss_db_per_m=1000.0)
    two_fields_db = itu_db(0.3 * np.sqrt(2 * 5 / (WAVELENGTH_M * 2 * 3))) - 20 * np.log10(2)
    assert -20 * np.log10(past(tall)) == pytest.approx(two_fields_db, abs=0.2)
    through = past(Shadow(semi_axes_m=(0.3, 0.3, 0.3), loss_db_per_m=10.0))
    around = past(BODY)
    assert through == pytest.approx(around + (1 - around) * 10 ** (-10 * 0.6 / 20), abs=1e-6)
    assert past(BODY, begin_m=1.0) == 1, "behind an end"
    box = Obstacle(min_m=(6, -1, -1), max_m=(7, 1, 1), material="metal")
    assert np.all(boxes_blocked([box], np.zeros((2, 3)), np.array([[5.0, 0, 0], [-5.0, 0, 0]]))[0] == 0)


COSINES = np.cos(np.radians([0.0, 20.0, 45.0, 70.0, 89.0]))


@pytest.mark.parametrize("epsilon", [2.0, 5.24 - 0.61j, 80.0 - 4.0j])
def test_fresnels_coefficients_by_snells_law(epsilon):
    """As in optics books, with the angle of refraction; the code uses no angle."""
    index, incidence = np.sqrt(epsilon + 0j), np.arccos(COSINES)
    refraction = np.arcsin(np.sin(incidence) / index)
    across = -np.sin(incidence[1:] - refraction[1:]) / np.sin(incidence[1:] + refraction[1:])
    along = np.tan(incidence[1:] - refraction[1:]) / np.tan(incidence[1:] + refraction[1:])
    s, p = fresnel(epsilon, COSINES)
    np.testing.assert_allclose(s[1:], across, rtol=1e-9)
    np.testing.assert_allclose(p[1:], along, rtol=1e-9)
    assert (s[0], p[0]) == (pytest.approx((1 - index) / (1 + index)), pytest.approx(-(1 - index) / (1 + index)))


@pytest.mark.parametrize(("name", "loss_db"), [("concrete", 7.7), ("drywall", 12.7), ("glass", 7.4), ("metal", 0.0)])
def test_reflection_loss_of_materials_straight_on(name, loss_db):
    """20 log10((n + 1)/(n - 1)) of their refractive index, whose imaginary part hardly matters."""
    s, _ = fresnel(permittivity(name), np.ones(1))
    assert -20 * np.log10(abs(s[0])) == pytest.approx(loss_db, abs=0.1)


def test_a_lossy_material_has_its_stated_loss():
    """A wave exp(-j k n z) through a metre of it."""
    n = np.sqrt(permittivity(Material(loss_db_per_m=80.0, index=2.4)))
    assert -20 * np.log10(abs(np.exp(-2j * np.pi / WAVELENGTH_M * n))) == pytest.approx(80.0, rel=1e-9)
    assert n.real == pytest.approx(2.4)


def test_roughness_reduces_reflections_as_rayleigh_states():
    """Path differences of 2 h cos(theta) spread phases by 4 pi h cos(theta)/wavelength, averaged over a Gaussian."""
    rng = np.random.default_rng(1)
    for cosine in (1.0, 0.5):
        phase = 4 * np.pi * rng.normal(0, 0.006, 400_000) * cosine / WAVELENGTH_M
        expected = abs(np.mean(np.exp(1j * phase)))
        assert roughness_factor(0.006, np.array([cosine]))[0] == pytest.approx(expected, abs=0.005)
