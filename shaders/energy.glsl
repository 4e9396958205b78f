// Part of each pair in U_total (eq. 7): cliques with its sites as middle, and their data terms.
//
//     share = sum over the four lines of V(s, t, u) + p_row |y_row - d_row| + p_col |y_col - d_col|
//
// added for both sites of the pair.
//
// Inputs:  displacement  d, pixels; pairs
//          straight, diagonal  stiffness ratios (ratios.glsl)
//          weights       weight of each line, no unit (cliques.glsl)
//          observation   (y in pixels, p = K c in energy per pixel)
// Outputs: share         pixels squared; one value for each pair
// Border rule: cliques that leave the image do not exist; reads are clamped to the image.

void read_row(ivec2 pair, out vec2 row[4])
{
    read_pairs(displacement, pair, row);
}

/// Return the energy of a site, number k of the middle row.
float share_of(ivec2 site, int k)
{
    return centred(site, k).energy + observed(here[k], texelFetch(observation, site, 0));
}

void kernel(ivec2 pair)
{
    look_around(pair);
    ivec2 site = first_of(clamped(pair, textureSize(displacement, 0)));
    share = share_of(site, 1) + share_of(site + HORIZONTAL, 2);
}
