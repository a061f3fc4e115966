/* Where the lit points are that are left: k-means in single precision, as inspection.chief.points.cluster. */

static V centres[3 * CLUSTERS];
static M alive[CLUSTERS];

const float *clusters_centres(void)
{
    return centres;
}

const int *clusters_alive(void)
{
    return alive;
}

void clusters_begin(void)
{
    for (int k = 0; k < CLUSTERS; ++k) {
        alive[k] = 0;
        centres[k] = centres[CLUSTERS + k] = centres[(2 * CLUSTERS) + k] = 0.0F;
    }
}

static float distance_squared(const float p[3], const float m[3])
{
    return (((p[0] * p[0]) + (p[1] * p[1])) + (p[2] * p[2])) + (((m[0] * m[0]) + (m[1] * m[1])) + (m[2] * m[2]))
           - (2.0F * (((p[0] * m[0]) + (p[1] * m[1])) + (p[2] * m[2])));
}

static void nearer(float gap[POINTS], int k)
{
    const float m[3] = {centres[k], centres[CLUSTERS + k], centres[(2 * CLUSTERS) + k]};
    for (int i = 0; i < POINTS; ++i) {
        const float own = distance_squared(points[i], m);
        gap[i] = (own < gap[i]) ? own : gap[i];
    }
}

/* Puts every missing one of the first centres on the wanted point that is farthest from the others. */
static void seed(const M wanted[POINTS], int count)
{
    float gap[POINTS];
    M missing[CLUSTERS];
    for (int i = 0; i < POINTS; ++i) {
        gap[i] = INFINITY;
    }
    for (int k = 0; k < CLUSTERS; ++k) {
        missing[k] = (k < count) && !alive[k];
        if (alive[k]) {
            nearer(gap, k);
        }
    }
    for (int k = 0; k < CLUSTERS; ++k) {
        if (missing[k]) {
            int farthest = 0;
            for (int i = 1; i < POINTS; ++i) {
                const float best = wanted[farthest] ? gap[farthest] : -1.0F;
                farthest = ((wanted[i] ? gap[i] : -1.0F) > best) ? i : farthest;
            }
            for (int j = 0; j < 3; ++j) {
                centres[(j * CLUSTERS) + k] = points[farthest][j];
            }
            alive[k] = 1;
            nearer(gap, k);
        }
    }
}

void clusters_settle(const int wanted[POINTS])
{
    V after[3 * CLUSTERS];
    V size[CLUSTERS];
    int count = 0;
    int living = 0;
    for (int i = 0; i < POINTS; ++i) {
        count += wanted[i];
    }
    count = (count + PER_CLUSTER - 1) / PER_CLUSTER;
    for (int k = 0; k < CLUSTERS; ++k) {
        alive[k] = alive[k] && (k < count);
        living += alive[k];
    }
    if (living < count) {
        seed(wanted, count);
    }
    for (int times = 0; times < ITERATIONS; ++times) {
        lloyd(centres, wanted, alive, after, size);
        for (int i = 0; i < 3 * CLUSTERS; ++i) {
            centres[i] = after[i];
        }
    }
    for (int k = 0; k < CLUSTERS; ++k) {
        alive[k] = alive[k] && (size[k] > 0.0F);
    }
}
