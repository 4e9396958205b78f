// Restriction of forces, or of counts of prescribed components, to the next coarser level.
//
//     coarse = P^T fine
//
// with the trilinear interpolation P (volume_interpolate.glsl): coarse site i coincides with fine
// site 2 i, and the neighbouring fine sites have weight 1/2 along each axis.
//
// Inputs:  fine                     vector of the finer level, any unit
//          fine_height, fine_width  number of rows and columns of the finer level
// Outputs: coarse                   unit of `fine`; the kernel runs on the coarser level
// Border rule: the border around the finer grid is 0.

uniform int fine_height;
uniform int fine_width;

/// Return the weighted sum over a row of fine sites.
float along(int k, int at)
{
    return fine[k].at[at] + 0.5 * (fine[k].at[at - 1] + fine[k].at[at + 1]);
}

/// Return the weighted sum over a plane of fine sites.
float across(int k, int at, int next)
{
    return along(k, at) + 0.5 * (along(k, at - next) + along(k, at + next));
}

void kernel(int at)
{
    int next = fine_width + 4;
    int deeper = (fine_height + 4) * next;
    int middle = number_of(2 * plane, 2 * row, 2 * col, fine_height, fine_width);
    for (int k = 0; k < 3; ++k) {
        float beside = across(k, middle - deeper, next) + across(k, middle + deeper, next);
        coarse[k].at[at] = across(k, middle, next) + 0.5 * beside;
    }
}
