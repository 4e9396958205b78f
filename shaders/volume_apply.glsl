// Product of the matrix and a displacement, such as a search direction.
//
//     image = (A + W) d where a component is free, 0 elsewhere;    total = d . image
//
// Inputs:  displacement  d, voxels
//          inverse       D^-1; 0 where a component is fixed
//          lame, shape, share  elements (hexahedra.glsl)
//          springs       diagonal matrix W, if SPRINGS; components in consecutive blocks
// Outputs: image         voxels times stiffness
//          shares        d . image of each group
// Border rule: elements that extend beyond the volume do not exist.

void kernel(int at)
{
    int size = (depth + 4) * stride();
    for (int k = 0; k < 3; ++k) {
        float pulls = force[k];
#if SPRINGS
        pulls += springs.at[k * size + at] * displaced(k);
#endif
        pulls = inverse[k].at[at] > 0.0 ? pulls : 0.0;
        image[k].at[at] = pulls;
        total += pulls * displaced(k);
    }
}
