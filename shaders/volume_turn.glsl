// Next search direction of conjugate gradients.
//
//     direction = steepest + ratio direction
//
// Inputs:  steepest, direction  voxels
//          scalars, above, below  scalars of the ratio (volume_scalars.glsl)
// Outputs: direction            voxels
// Border rule: none needed, because a site reads only its own values.

void kernel(int at)
{
    float part = ratio();
    for (int k = 0; k < 3; ++k) {
        direction[k].at[at] = steepest[k].at[at] + part * direction[k].at[at];
    }
}
