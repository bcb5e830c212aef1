"""Units of what is stored and printed, where they meet SI: nanoseconds in recordings, parts per million on boards.

What a scenario says in other units its models give in SI (`Tag.antenna_delays_s`, `Radio.rx_noise_s`), so that no
module between these edges converts anything.
"""

from typing import Final

PS: Final = 1e-12
NS: Final = 1e-9
US: Final = 1e-6
MS: Final = 1e-3
MM: Final = 1e-3
CM: Final = 1e-2
PPM: Final = 1e-6

PS_PER_S: Final = 1e12
NS_PER_S: Final = 1_000_000_000
PPM_PER_ONE: Final = 1e6
