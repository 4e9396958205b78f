// Product of the matrix and a displacement, such as a search direction.
//
//     image = A d where a component is free, 0 elsewhere;    share = d . image
//
// Inputs:  displacement      d, pixels; pairs
//          lame              elastic prior: Lame parameters of elements (elements.glsl); pairs
//          straight, diagonal  paper's prior: stiffness ratios (ratios.glsl)
//          inverse_diagonal  D^-1; 0 where a component is fixed; pairs
// Outputs: image             pixels times stiffness; pairs
//          share             contribution of each pair to the scalar product
// Border rule: elements and cliques that extend beyond the image do not exist; reads are clamped.

void read_row(ivec2 pair, out vec2 row[4])
{
    read_pairs(displacement, pair, row);
}

void kernel(ivec2 pair)
{
    find_forces(pair);
    vec4 inverses = texelFetch(inverse_diagonal, clamped(pair, textureSize(displacement, 0)), 0);
    bvec4 moves = greaterThan(inverses, vec4(0.0));
    image = mix(vec4(0.0), vec4(force[0], force[1]), moves);
    share = dot(image, vec4(here[1], here[2]));
}
