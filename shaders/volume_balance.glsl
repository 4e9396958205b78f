// Residual of a displacement in double precision, for the convergence test.
//
//     rest = - A d / unit where a component is free, 0 elsewhere
//
// Inputs:  displacement  d in double precision, voxels
//          inverse       D^-1; 0 where a component is fixed
//          lame, shape, share  elements (hexahedra.glsl)
//          unit          unit of the result, voxels times stiffness
// Outputs: rest          in units of `unit`, in single precision
//          shares        rest . rest and the largest absolute value of each group
// Border rule: elements that extend beyond the volume do not exist.

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
