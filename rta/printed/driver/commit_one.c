/* The check of one spacecraft's control. */
static void check_control(const double x[16], double control[6], struct safety_filter_output *out)
{
    int broken[LIMITS];
    int safe[2];
    int changed[2];
    double status[2];
    int strange = 0;
    for (int i = 0; i < 16; ++i) {
        strange |= (isfinite(x[i]) != 0) ? 0 : 1;
    }
    for (int group = THRUST; group <= TORQUE; ++group) {
        status[group] = out->program_status[group];
    }
    are_broken(out->h, broken);
    commit(x, broken, strange, control, safe, changed);
    nothing_yields(broken, safe, changed, out->slack, status);
    for (int group = THRUST; group <= TORQUE; ++group) {
        out->program_status[group] = (int)status[group];
    }
    out->backup = (changed[THRUST] || changed[TORQUE]) ? 1 : 0;
    out->verified = is_verified(broken, safe);
}
