/* Thrust that the thrusters give. */
static void round_thrust(V control[6])
{
#if COARSE
    V given[3];
    given_thrust(control, given);
    for (int j = 0; j < 3; ++j) {
        control[j] = given[j];
    }
#else
    (void)control;
#endif
}
