// Parameters of a coarser level's elements, relative to the side of its voxels.
//
//     coarse = (sum of fine over the eight elements) / 4
//
// This is twice the mean, because the energy of an element is proportional to its side length.
//
// Inputs:  fine                     mu or lambda of the finer level's elements
//          fine_height, fine_width  number of rows and columns of the finer level
// Outputs: coarse                   unit of `fine`; the kernel runs on the coarser level
// Border rule: elements outside the grid are void.

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
