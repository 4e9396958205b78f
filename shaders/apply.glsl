// What the tissue answers to a direction: the stiffness matrix times it.
//
//     image = A d where a component moves, 0 elsewhere;    share = d . image
//
// Inputs:  direction         d, pixels; pairs
//          lame              Lame's parameters of the elements (elements.glsl); pairs
//          inverse_diagonal  D^-1, 0 where a component does not move; pairs
// Outputs: image             pixels times stiffness; pairs
//          share             a pair's part of the scalar product
// Border rule: elements beyond the border are void; reads are clamped to the image.

void read_row(ivec2 pair, out vec2 row[4])
{
    read_pairs(direction, pair, row);
}

void kernel(ivec2 pair)
{
    look_around(pair);
    vec4 inverses = texelFetch(inverse_diagonal, clamped(pair, textureSize(direction, 0)), 0);
    bvec4 moves = greaterThan(inverses, vec4(0.0));
    image = mix(vec4(0.0), vec4(force[0], force[1]), moves);
    share = dot(image, vec4(here[1], here[2]));
}
