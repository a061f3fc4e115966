/* The check of one spacecraft's control. */
static void check_control(const double x[16], const double error_bound[4], double control[6], struct safety_filter_output *out)
{
    double y[20];
    int broken[LIMITS];
    int fit[2];
    int safe[2];
    int changed[2];
    double status[2];
    copy(y, x, 16);
    copy(&y[16], error_bound, 4);
    for (int group = THRUST; group <= TORQUE; ++group) {
        status[group] = out->program_status[group];
    }
    are_fit(y, out->h, broken, fit);
    commit(y, broken, fit, control, safe, changed);
    nothing_yields(broken, safe, changed, out->slack, status);
    for (int group = THRUST; group <= TORQUE; ++group) {
        out->program_status[group] = (int)status[group];
    }
    out->backup = (changed[THRUST] || changed[TORQUE]) ? 1 : 0;
    out->verified = is_verified(broken, safe);
}
