// The sum of all groups' totals and the largest of their largest values, by one work group.
//
// Inputs:  shares      (total, most) of each group (stage_volume.glsl)
//          count       how many groups there are
//          slot        where the results go
// Outputs: scalars     total at `slot`, most after it
// Border rule: none needed.

layout(local_size_x = TOGETHER) in;

uniform int count;
uniform int slot;

shared float totals[TOGETHER];
shared float largest[TOGETHER];

void main()
{
    int local = int(gl_LocalInvocationIndex);
    float total = 0.0;
    float most = 0.0;
    for (int group = local; group < count; group += TOGETHER) {
        total += shares.at[2 * group];
        most = max(most, shares.at[2 * group + 1]);
    }
    totals[local] = total;
    largest[local] = most;
    for (int part = TOGETHER / 2; part > 0; part /= 2) {
        memoryBarrierShared();
        barrier();
        if (local < part) {
            totals[local] += totals[local + part];
            largest[local] = max(largest[local], largest[local + part]);
        }
    }
    if (local == 0) {
        scalars.at[slot] = totals[0];
        scalars.at[slot + 1] = largest[0];
    }
}
