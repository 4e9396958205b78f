// Trilinear interpolation of the coarser level's correction.
//
//     correction += P coarse where a component is free
//
// with the trilinear interpolation P. Coarse site i coincides with fine site 2 i along each axis.
//
// Inputs:  correction  correction of the level, voxels
//          coarse      correction of the coarser level, voxels
//          inverse     D^-1; 0 where a component is fixed
//          coarse_height, coarse_width  number of rows and columns of the coarser level
// Outputs: correction  voxels
// Border rule: none needed, because all sites of the grid are between coarse sites.

uniform int coarse_height;
uniform int coarse_width;

void kernel(int at)
{
    int across = col & 1;
    int next = (row & 1) * (coarse_width + 4);
    int deeper = (plane & 1) * (coarse_height + 4) * (coarse_width + 4);
    int near = number_of(plane >> 1, row >> 1, col >> 1, coarse_height, coarse_width);
    int far = near + deeper;
    for (int k = 0; k < 3; ++k) {
        float value = coarse[k].at[near] + coarse[k].at[near + across];
        value += coarse[k].at[near + next] + coarse[k].at[near + next + across];
        value += coarse[k].at[far] + coarse[k].at[far + across];
        value += coarse[k].at[far + next] + coarse[k].at[far + next + across];
        if (inverse[k].at[at] > 0.0) {
            correction[k].at[at] += 0.125 * value;
        }
    }
}
