"""The conditions on a control that keep the limits: of the rate now, and of a zero-order hold."""
