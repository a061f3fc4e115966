typedef double safety_filter_real; /* of all numbers */

struct safety_filter_input {
    safety_filter_real state[16];     /* in the order of enum safety_filter_state */
    safety_filter_real desired[6];    /* in the order of enum safety_filter_control; any numbers, also beyond the
                                         actuators' limits */
    safety_filter_real sent[SAFETY_FILTER_SENT_ROOM][6]; /* controls held since the state was measured, the oldest
                                         first, each for a period; read where SAFETY_FILTER_LATENCY is not 0 */
    int sent_count;                   /* of them, 0 if there are none; of more than SAFETY_FILTER_LATENCY the state is too old: UNSOLVED */
};

/* Of constraints in the order of enum safety_filter_constraint; rates are those of h, per s, or per s^2 where thrust
 * or torque changes h only by way of its rate. */
struct safety_filter_output {
    safety_filter_real control[6];    /* as desired[6], within the actuators' limits, to be held for a period */
    int status;                       /* enum safety_filter_status */
    int verified;                     /* 1: no limit is violated while control is held, and then on a backup
                                         trajectory; 0: no such one is known, or there is no check */
    int backup;                       /* 1: the check replaced the program's control by one nearer to the backup law's */
    int violated;                     /* 1: a limit is broken already, some h is negative, whatever the status */
    safety_filter_real h[SAFETY_FILTER_CONSTRAINTS];     /* values of the constraints: negative is a violation */
    safety_filter_real slack[SAFETY_FILTER_CONSTRAINTS]; /* by how much the program's control misses a condition, a rate; 0: it meets it, or verified */
    int active[SAFETY_FILTER_CONSTRAINTS];               /* 1: the constraint determines the corrected control */
};

/* Fills all of *out. It keeps nothing between calls: any number of threads may call it. */
void safety_filter(const struct safety_filter_input *in, struct safety_filter_output *out);
