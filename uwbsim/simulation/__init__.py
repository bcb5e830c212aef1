"""A flight: schedule, air, time stamps, listeners, recording."""
