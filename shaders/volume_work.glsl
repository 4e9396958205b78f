// Energy or squared forces of a displacement, in double precision.
//
//     total = d . A d if power is 1,    A d . A d if power is 2
//
// Inputs:  displacement  d in double precision, voxels
//          lame, shape, share  elements (hexahedra.glsl)
//          power         1 or 2
// Outputs: shares        total of each group
// Border rule: elements that extend beyond the volume do not exist.

uniform int power;

void kernel(int at)
{
    for (int k = 0; k < 3; ++k) {
        total += force[k] * (power == 1 ? displaced(k) : force[k]);
    }
}
