// The coarser level's correction added on a level, trilinear, to the sites that move.
//
// Inputs:  correction  so far, voxels
//          coarse      the coarser level's, voxels: its site i lies on site 2 i
//          inverse     D^-1; 0 where a component does not move
//          coarse_height, coarse_width  how many sites that level has
// Outputs: correction  voxels
// Border rule: every site of the grid lies between coarse ones.

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
