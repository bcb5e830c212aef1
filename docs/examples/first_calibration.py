"""Simulate two flights, calibrate with one, look at it, correct ranges of one's own, and judge it on the other."""

import numpy as np

import calib
import uwbsim

train = uwbsim.simulate(uwbsim.load("scenarios/icra2023/train.toml", {"run.duration_s": 60.0}))
test = uwbsim.simulate(uwbsim.load("scenarios/icra2023/test1.toml", {"run.duration_s": 30.0}))

result = calib.fit(train)
print(result)
result.plot_bias().figure.savefig("bias.png")
result.save("first.json", force=True)

calibration = calib.load_calibration("first.json")
one = calibration.correct(3.21, fpp1_dbm=-84.5, fpp2_dbm=-86.0, initiator=1, target=3)
print(f"3.21 m corrected: {one.range_m:.3f} m, standard deviation {one.sigma_m:.3f} m")
ranges, powers = np.array([3.21, 4.05, 2.87]), np.array([-84.5, -90.1, -83.0])
print(calibration.correct(ranges, powers, powers, initiator=1, target=np.array([3, 4, 6])).range_m)

found = calib.evaluate(test, calibration).overall
print(f"raw       mean {100 * found.raw.mean_m:+.1f} cm, robust deviation {100 * found.raw.robust_std_m:.1f} cm")
print(f"corrected mean {100 * found.full.mean_m:+.1f} cm, robust deviation {100 * found.full.robust_std_m:.1f} cm")
