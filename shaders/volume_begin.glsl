// First step of a level's smoother, from zero.
//
//     begun = scale D^-1 load
//
// Inputs:  load     load of the level, voxels times stiffness
//          inverse  D^-1; 0 where a component is fixed
//          scale    no unit
// Outputs: begun    voxels
// Border rule: none needed, because a site reads only its own values.

uniform float scale;

void kernel(int at)
{
    for (int k = 0; k < 3; ++k) {
        begun[k].at[at] = scale * inverse[k].at[at] * load[k].at[at];
    }
}
