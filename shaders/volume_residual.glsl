// Residual of a level.
//
//     rest = load - (A + W) d where a component is free, 0 elsewhere
//
// Inputs:  displacement  correction d, voxels
//          load          load of the level, voxels times stiffness
//          inverse       D^-1; 0 where a component is fixed
//          lame, shape, share  elements (hexahedra.glsl)
//          springs       diagonal matrix W, if SPRINGS; components in consecutive blocks
// Outputs: rest          voxels times stiffness
// Border rule: elements that extend beyond the volume do not exist.

void kernel(int at)
{
    int size = (depth + 4) * stride();
    for (int k = 0; k < 3; ++k) {
        float pulls = force[k];
#if SPRINGS
        pulls += springs.at[k * size + at] * displaced(k);
#endif
        rest[k].at[at] = inverse[k].at[at] > 0.0 ? load[k].at[at] - pulls : 0.0;
    }
}
