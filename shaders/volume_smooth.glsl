// Chebyshev-Jacobi step of a level's smoother.
//
//     other = d + scale D^-1 (load - (A + W) d) + ahead d - back other
//
// Inputs:  displacement  correction d, voxels
//          load          load of the level, voxels times stiffness
//          inverse       D^-1 of A + W; 0 where a component is fixed
//          lame, shape, share  elements (hexahedra.glsl)
//          springs       diagonal matrix W, if SPRINGS; components in consecutive blocks
//          other         correction before the previous step, voxels; no effect if `back` is 0
//          scale, ahead, back  no unit
// Outputs: other         correction after this step, voxels
// Border rule: elements that extend beyond the volume do not exist.

uniform float scale;
uniform float ahead;
uniform float back;

void kernel(int at)
{
    int size = (depth + 4) * stride();
    for (int k = 0; k < 3; ++k) {
        float d = displaced(k);
        float pulls = force[k];
#if SPRINGS
        pulls += springs.at[k * size + at] * d;
#endif
        float way = scale * inverse[k].at[at] * (load[k].at[at] - pulls) + ahead * d;
        other[k].at[at] = d + (way - back * other[k].at[at]);
    }
}
