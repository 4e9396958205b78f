// Step of an iteration along a search direction.
//
//     found += ratio direction,    rest -= ratio image,    total = rest . rest
//
// Inputs:  found, direction  voxels
//          rest, image       voxels times stiffness
//          scalars, above, below  scalars of the ratio (volume_scalars.glsl)
// Outputs: found             voxels
//          rest              voxels times stiffness
//          shares            rest . rest of each group
// Border rule: none needed, because a site reads only its own values.

void kernel(int at)
{
    float way = ratio();
    for (int k = 0; k < 3; ++k) {
        found[k].at[at] += way * direction[k].at[at];
        float left = rest[k].at[at] - way * image[k].at[at];
        rest[k].at[at] = left;
        total += left * left;
    }
}
