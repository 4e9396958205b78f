// The work that a displacement took and the forces with which tissue answers, in double precision.
//
//     total = d . A d,    or |A d|^2
//
// Inputs:  displacement  d in double precision, voxels
//          lame, shape, share  the elements (hexahedra.glsl)
//          power         1: of the work; 2: of the square of the forces
// Outputs: shares        of the work, or of the square
// Border rule: elements that leave the volume do not exist.

uniform int power;

void kernel(int at)
{
    for (int k = 0; k < 3; ++k) {
        total += force[k] * (power == 1 ? displaced(k) : force[k]);
    }
}
