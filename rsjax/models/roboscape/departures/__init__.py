"""What RoboScape can do here that the paper does not have: one file and one reason each, all off by default.

The settings are :class:`rsjax.config.Departures`; the method calls each departure at one place.
"""
