/* The filter for one spacecraft. It keeps nothing between calls: any number of threads may call it. */

struct safety_filter_input {
    double state[16];             /* p (m) and v (m/s) in Hill's frame, attitude q (body to Hill, scalar last), body
                                     rates (rad/s), temperature (deg C), energy (kJ), angle of the Sun (rad) */
    double desired[6];            /* thrust (N) and torque (N m) in the body's frame */
    double sent[SENT_ROOM][6];    /* controls held since the state was measured, the oldest first, each for a period */
    int sent_count;               /* of them; of more than LATENCY the state is too old, and the status UNSOLVED */
    double left[6];               /* share that each actuator gives of what it is told; read where HEALTH is 1 */
};

struct safety_filter_output {
    double control[6];              /* N and N m, within the actuators' limits, to be held for a period */
    int status;                     /* 0 as desired; 1 every row is held; 2 some yield; 3 unsolved: the worse of both */
    int program_status[2];          /* of thrust, of torque */
    double residual[2];             /* of the optimality conditions of a program whose solution is applied, else 0 */
    double h[CONSTRAINTS];          /* values of the constraints, in the order of their names */
    double slack[CONSTRAINTS];      /* shortfall of a condition, in h's unit per s, or per s^2 of relative degree two */
    int active[CONSTRAINTS];        /* 1 where a row of the constraint binds a corrected control */
    double uncertainty[CONSTRAINTS]; /* what bounds of the unknown take off a condition, in slack's unit */
    double tightened[CONSTRAINTS];  /* that, in the unit of the barrier */
};

void safety_filter(const struct safety_filter_input *in, struct safety_filter_output *out);
