// Forces of a finer level, or what it holds, handed down to a level.
//
//     coarse = P^T fine
//
// with P the trilinear interpolation by which the correction will come back: coarse site i lies on
// fine site 2 i and takes a half of what the fine sites beside it have, along each axis.
//
// Inputs:  fine                     any unit
//          fine_height, fine_width  how many sites that level has
// Outputs: coarse                   the same unit, on the level that the kernel runs for
// Border rule: beyond the border there is nothing.

uniform int fine_height;
uniform int fine_width;

/// What a row of fine sites hands down.
float along(int k, int at)
{
    return fine[k].at[at] + 0.5 * (fine[k].at[at - 1] + fine[k].at[at + 1]);
}

/// What a plane of fine sites hands down.
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
