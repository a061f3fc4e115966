/* Thrust that the thrusters give. */
static void round_thrust(V control[6])
{
#if QUANTISED
    V quantised[3];
    quantised_thrust(control, quantised);
    for (int j = 0; j < 3; ++j) {
        control[j] = quantised[j];
    }
#else
    (void)control;
#endif
}
