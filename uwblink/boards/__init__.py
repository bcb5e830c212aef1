"""Boards on serial ports: driver, plans, recorder, replay."""
