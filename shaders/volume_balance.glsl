// What a displacement leaves, in double precision: the residual that decides.
//
//     rest = - A d / unit where a component moves, 0 elsewhere
//
// Inputs:  displacement  d in double precision, voxels
//          inverse       D^-1; 0 where a component does not move
//          lame, shape, share  the elements (hexahedra.glsl)
//          unit          what the rest is counted in, voxels times stiffness
// Outputs: rest          in single precision
//          shares        of the square of its norm, and its largest absolute value
// Border rule: elements that leave the volume do not exist.

uniform double unit;

void kernel(int at)
{
    for (int k = 0; k < 3; ++k) {
        REAL left = inverse[k].at[at] > 0.0 ? -force[k] / unit : REAL(0);
        rest[k].at[at] = float(left);
        total += left * left;
        most = max(most, abs(left));
    }
}
