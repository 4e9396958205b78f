// All smoothing steps of the coarsest level in one work group, with one site per invocation.
//
//     step = scale D^-1 (load - (A + W) d) + momentum step,    d = d + step,    from d = 0
//
// Inputs:  load          load of the level, voxels times stiffness
//          inverse       D^-1 of A + W; 0 where a component is fixed
//          lame, shape, share  elements (hexahedra.glsl)
//          springs       diagonal matrix W, if SPRINGS; components in consecutive blocks
//          count         number of steps
//          paces         (scale, momentum) of each step, no unit
// Outputs: correction    d, voxels
// Border rule: elements that extend beyond the volume do not exist.

layout(local_size_x = SITES) in;

uniform int count;
uniform float paces[2 * MOST_STEPS];

void main()
{
    int local = int(gl_LocalInvocationIndex);
    for (int number = local; number < 3 * TILE; number += SITES) {
        tile[number] = 0.0;
    }
    bool runs = local < depth * height * width;
    int site = runs ? local : 0;
    int at = number_of(site / (height * width), site / width % height, site % width, height, width);
    float d[3];
    float way[3];
    for (int k = 0; k < 3; ++k) {
        d[k] = way[k] = 0.0;
    }
    for (int number = 0; number < count; ++number) {
        memoryBarrierShared();
        barrier();
        enter(at);
        find_forces(at);
        for (int k = 0; k < 3; ++k) {
            float pulls = force[k];
#if SPRINGS
            pulls += springs.at[k * (depth + 4) * stride() + at] * d[k];
#endif
            float rest = load[k].at[at] - pulls;
            way[k] = paces[2 * number] * inverse[k].at[at] * rest + paces[2 * number + 1] * way[k];
            d[k] += way[k];
        }
        barrier();
        if (runs) {
            for (int k = 0; k < 3; ++k) {
                tile[k * TILE + at] = d[k];
            }
        }
    }
    if (runs) {
        for (int k = 0; k < 3; ++k) {
            correction[k].at[at] = d[k];
        }
    }
}
