// Compute shader of a kernel for volumes, in work groups of GROUP_COLS x GROUP_ROWS columns of
// sites, `planes` deep. An invocation computes the sites of one column, plane by plane.
//
// A kernel runs on listed groups, which contain free sites, or on all groups. If SHARES, the kernel
// updates `total` and `most`, and each group computes the sum and the maximum over its invocations.
//
// Inputs:  places        indices of the listed groups; the column axis is the fastest
//          listed        1 for listed groups, 0 for all groups
//          first, past   range of entries of the list, or of group indices; `past` is exclusive
// Outputs: shares        if SHARES, (total, most) of each group that runs, in the same order
// Border rule: sites outside the grid are not computed.

layout(local_size_x = GROUP_COLS, local_size_y = GROUP_ROWS) in;

uniform int planes;
uniform int listed;
uniform int first;
uniform int past;

#if SHARES
shared REAL totals[GROUP_COLS * GROUP_ROWS];
shared REAL largest[GROUP_COLS * GROUP_ROWS];

/// Reduce the totals and the largest values of all invocations to the first entries.
void reduce()
{
    int local = int(gl_LocalInvocationIndex);
    totals[local] = total;
    largest[local] = most;
    for (int half_of = GROUP_COLS * GROUP_ROWS / 2; half_of > 0; half_of /= 2) {
        memoryBarrierShared();
        barrier();
        if (local < half_of) {
            totals[local] += totals[local + half_of];
            largest[local] = max(largest[local], largest[local + half_of]);
        }
    }
}
#endif

void main()
{
    int across = (width + GROUP_COLS - 1) / GROUP_COLS;
    int down = (height + GROUP_ROWS - 1) / GROUP_ROWS;
    int entry = first + int(gl_WorkGroupID.x + gl_WorkGroupID.y * gl_NumWorkGroups.x);
    bool runs = entry < past;
    int group = runs && listed == 1 ? places.at[entry] : entry;
    col = group % across * GROUP_COLS + int(gl_LocalInvocationID.x);
    row = group / across % down * GROUP_ROWS + int(gl_LocalInvocationID.y);
    plane = group / (across * down) * planes;
    if (runs && row < height && col < width) {
        int at = number_of(plane, row, col, height, width);
        int last = min(plane + planes, depth);
#if FORCES
        enter(at);
#endif
        for (; plane < last; ++plane) {
#if FORCES
            find_forces(at);
#endif
            kernel(at);
            at += stride();
        }
    }
#if SHARES
    reduce();
    if (runs && gl_LocalInvocationIndex == 0u) {
        shares.at[2 * entry] = totals[0];
        shares.at[2 * entry + 1] = largest[0];
    }
#endif
}
