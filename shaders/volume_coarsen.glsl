// The parameters of a coarser level's elements, in its own unit: the sum of the eight over four.
//
// Inputs:  fine                     mu or lambda of the finer level's elements
//          fine_height, fine_width  how many sites that level has
// Outputs: coarse                   the same of the coarser level, which the kernel runs for
// Border rule: beyond the border elements are void.

uniform int fine_height;
uniform int fine_width;

void kernel(int at)
{
    int next = fine_width + 4;
    int deeper = (fine_height + 4) * next;
    int first = number_of(2 * plane, 2 * row, 2 * col, fine_height, fine_width);
    float near = fine.at[first] + fine.at[first + next];
    float far = fine.at[first + deeper] + fine.at[first + deeper + next];
    float one = near + far;
    near = fine.at[first + 1] + fine.at[first + next + 1];
    far = fine.at[first + deeper + 1] + fine.at[first + deeper + next + 1];
    coarse.at[at] = 0.25 * (one + (near + far));
}
