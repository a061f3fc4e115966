"""Names of the 16 state components. The component axis comes first: x is (16,) or (16, batch).

| symbol  | meaning                                     | unit  |
|---------|---------------------------------------------|-------|
| p       | position of the deputy, Hill frame          | m     |
| v       | velocity of the deputy, Hill frame          | m/s   |
| q       | attitude, body to Hill, scalar last         | -     |
| omega   | body rates, body frame                      | rad/s |
| T       | temperature of the tracked surface          | deg C |
| E       | battery energy                              | kJ    |
| theta_S | angle of the Sun from +x in the x-y plane   | rad   |
"""

P = slice(0, 3)
V = slice(3, 6)
Q = slice(6, 10)
OMEGA = slice(10, 13)
T = 13
E = 14
THETA_S = 15
SIZE = 16

THRUST = slice(0, 3)
TORQUE = slice(3, 6)
CONTROLS = (*(f"thrust_{i}" for i in "xyz"), *(f"torque_{i}" for i in "xyz"))  # body axes, N and N m
CONTROL_SIZE = len(CONTROLS)
