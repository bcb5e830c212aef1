"""The one model of what a range's error is made of."""
