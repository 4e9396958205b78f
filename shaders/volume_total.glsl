// Sum of the totals of all groups, and maximum of their largest values, in one work group.
//
//     scalars[slot] = sum of total,    scalars[slot + 1] = max of most
//
// Inputs:  shares      (total, most) of each group, any units (stage_volume.glsl)
//          count       number of groups
//          slot        index of the first result
// Outputs: scalars     units of the shares
// Border rule: none needed, because no sites are read.

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
