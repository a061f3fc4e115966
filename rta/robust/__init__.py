"""Bounds on the errors of model, measurement and actuators."""
