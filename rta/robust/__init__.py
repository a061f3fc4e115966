"""The filter under bounds on the errors of model, measurement and actuators."""
