/*
 * What is done for a spacecraft of which a thruster is known to be dead or weak: it is turned in time.
 *
 * In every attitude the axes together give at least as much as one of them along any direction, and the keep-in zone
 * counts on that. With a dead axis on the radius there is nothing, and no thrust row can hold the zone. So near its
 * edge the torque that is asked for gives way to one that turns the dead axis across the radius.
 */

#define PI 3.14159265358979323846
#define TURN_STEP (7.5 * PI / 180.0) /* rad, between the turns that are compared */
#define TURNS 24                     /* of them about each axis, up to half a turn */

static double norm(const double a[3])
{
    return sqrt(dot(a, a, 3));
}

static void cross(const double a[3], const double b[3], double c[3])
{
    for (int i = 0; i < 3; ++i) {
        const int j = (i + 1) % 3;
        const int k = (i + 2) % 3;
        c[i] = (a[j] * b[k]) - (a[k] * b[j]);
    }
}

/* A vector of Hill's frame in the body's, by the attitude q (body to Hill). */
static void in_body(const double q[4], const double hill[3], double body[3])
{
    const double back[3] = {-q[0], -q[1], -q[2]};
    double once[3];
    double twice[3];
    cross(back, hill, once);
    cross(back, once, twice);
    for (int i = 0; i < 3; ++i) {
        body[i] = hill[i] + (q[3] * 2.0 * once[i]) + (2.0 * twice[i]);
    }
}

/* A direction in the frame of a body that was turned. */
static void seen(const double axis[3], double angle, const double a[3], double turned[3])
{
    double across[3];
    const double along = dot(axis, a, 3);
    cross(axis, a, across);
    for (int i = 0; i < 3; ++i) {
        turned[i] = (a[i] * cos(angle)) - (across[i] * sin(angle)) + (along * axis[i] * (1.0 - cos(angle)));
    }
}

/* How much of a direction is along axes that give less. */
static double astray(const double weakness[3], const double direction[3])
{
    const double part[3] = {weakness[0] * direction[0], weakness[1] * direction[1], weakness[2] * direction[2]};
    return norm(part);
}

/* The largest component. */
static double largest(const double a[3])
{
    return fmax(fabs(a[0]), fmax(fabs(a[1]), fabs(a[2])));
}

/* What turns about an axis cost, at least: the angle of that turn. */
static double soonest_about(const double axis[3], const double outwards[3], const double sun[3],
                            const double weakness[3], double *angle)
{
    const double never = (TURN_STEP * TURNS) + 1.0; /* s rad/s, above all times */
    double least = INFINITY;
    double blinded = 0.0; /* 1 once the Sun was in the camera on the way */
    for (int i = 1; i <= TURNS; ++i) {
        const double turn = TURN_STEP * (double)i;
        double there[3];
        double sun_there[3];
        seen(axis, turn, outwards, there);
        seen(axis, turn, sun, sun_there);
        blinded = (sun_there[0] <= COSINE_OF_EXCLUSION) ? blinded : 1.0;
        const double too_far = fmax(astray(weakness, there) - NEAR_RADIUS, 0.0) / NEAR_RADIUS;
        /* each axis turns at the limit at most */
        const double cost = (turn * largest(axis)) + (never * (too_far + (blinded / NEAR_RADIUS)));
        if (cost < least) {
            least = cost;
            *angle = turn;
        }
    }
    return least;
}

/* The turn after which healthy axes are along the radius soonest, past the Sun where possible: about which axis of
 * length one, and by how much in rad. */
static double soonest(const double outwards[3], const double sun[3], const double weakness[3], double about[3])
{
    double least = INFINITY;
    double best = 0.0;
    for (int i = 0; i < 27; ++i) {
        const double whole[3] = {(double)(i / 9) - 1.0, (double)((i / 3) % 3) - 1.0, (double)(i % 3) - 1.0};
        const double length = norm(whole);
        if (length > 0.0) {
            const double axis[3] = {whole[0] / length, whole[1] / length, whole[2] / length};
            double angle = 0.0;
            const double cost = soonest_about(axis, outwards, sun, weakness, &angle);
            if (cost < least) {
                least = cost;
                best = angle;
                copy(about, axis, 3);
            }
        }
    }
    return best;
}

/* 1 where the body would leave the zone by coasting for as long as the farthest turn takes, a right angle, and braking
 * from then on. */
static int leaves_the_zone(const double x[16], double torque)
{
    const double largest_inertia = largest(INERTIA);
    const double t = (PI / 2.0 / RATE_LIMIT) + (largest_inertia * RATE_LIMIT / torque) + HOLD;
    const double distance = norm(&x[0]);
    const double radial = dot(&x[0], &x[3], 3) / distance;
    const double later = radial + (NATURAL_ACCELERATION * t);
    const double reached = distance + (radial * t) + (NATURAL_ACCELERATION * (t * t) / 2.0) +
                           ((later * later) / (2.0 * LEAST_BRAKING));
    return ((later > 0.0) && (reached > MAX_DISTANCE)) ? 1 : 0;
}

/* The torque to be filtered in the place of that which is asked for, in N m. */
static void turn_in_time(const double x[16], const double left[6], double torque[3])
{
    const double strongest = fmax(left[0], fmax(left[1], left[2])); /* it can be turned onto the radius */
    const double weakness[3] = {strongest - left[0], strongest - left[1], strongest - left[2]};
    const double torques = LEAST_TORQUE * fmin(left[3], fmin(left[4], left[5])) * LIMIT[TORQUE];
    const double turned = sqrt(3.0) * RATE_LIMIT * HOLD; /* rad, in a hold at most */
    const double distance = norm(&x[0]);
    double outwards[3];
    in_body(&x[6], &x[0], outwards);
    for (int j = 0; j < 3; ++j) {
        outwards[j] /= distance;
    }
    const double off = astray(weakness, outwards);
    const int is_weak = ((off > (NEAR_RADIUS - turned)) && (largest(weakness) > 0.0) && (torques > 0.0)) ? 1 : 0;
    if ((is_weak != 0) && (leaves_the_zone(x, torques) != 0)) {
        const double sun_in_hill[3] = {cos(x[15]), sin(x[15]), 0.0};
        double sun[3];
        double axis[3] = {0.0};
        in_body(&x[6], sun_in_hill, sun);
        const double angle = soonest(outwards, sun, weakness, axis);
        const double speed = fmin(RATE_LIMIT / largest(axis), angle / HOLD);
        for (int j = 0; j < 3; ++j) {
            const double rate = (off > NEAR_RADIUS) ? (axis[j] * speed) : 0.0;
            const double wanted = INERTIA[j] * (rate - x[10 + j]) / HOLD;
            torque[j] = clip(wanted / left[3 + j], -LIMIT[TORQUE], LIMIT[TORQUE]);
        }
    }
}
