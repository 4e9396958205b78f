// A Chebyshev-Jacobi step of a level's smoother.
//
//     taken = scale D^-1 (load - (A + W) d) + momentum last,    corrected = d + taken
//
// with d what the correction is before it. START says what that is:
//     0  `correction`
//     1  the first step from zero, first_scale D^-1 load, which is `last` as well: two steps at once
//     2  `correction` with that of the coarser level added, bilinear, where sites move; a first
//        step, so that there is no `last`
//
// Inputs:  correction        d, pixels; pairs
//          load              what the level is relaxed for, pixels times stiffness; pairs
//          lame              Lame's parameters of the elements (elements.glsl); pairs
//          inverse_diagonal  D^-1 of A + W; 0 where a component does not move; pairs
//          springs           the diagonal matrix W, if SPRINGS; pairs
//          last              the step before, pixels; pairs
//          coarse            the coarser level's correction, pixels; pairs
//          first_scale, scale, momentum  no unit
// Outputs: corrected, taken  pixels; pairs
// Border rule: elements beyond the border are void; reads are clamped to the image. Coarse site i
// lies on fine site 2 i, so that every site that moves lies between coarse ones.

uniform float scale;
uniform float momentum;
#if START == 1
uniform float first_scale;
#endif

#if START == 2
/// The coarser level's correction at the sites of a row.
void read_coarse(ivec2 pair, out vec2 row[4])
{
    ivec2 size = textureSize(coarse, 0);
    ivec2 near = ivec2((pair.x - 1) >> 1, pair.y >> 1);
    ivec2 far = near + ivec2(0, pair.y & 1);
    vec4 first = texelFetch(coarse, clamped(near, size), 0);
    first += texelFetch(coarse, clamped(far, size), 0);
    near.x = far.x = (pair.x + 1) >> 1;
    vec4 second = texelFetch(coarse, clamped(near, size), 0);
    second += texelFetch(coarse, clamped(far, size), 0);
    // Twice the correction at three coarse sites: before the pair, on its first site and after it.
    bool odd = (pair.x & 1) == 1;
    vec2 before = odd ? first.xy : first.zw;
    vec2 on = odd ? first.zw : second.xy;
    vec2 after = odd ? second.xy : second.zw;
    row[0] = 0.25 * (before + on);
    row[1] = 0.5 * on;
    row[2] = 0.25 * (on + after);
    row[3] = 0.5 * after;
}
#endif

void read_row(ivec2 pair, out vec2 row[4])
{
#if START == 0
    read_pairs(correction, pair, row);
#else
    vec2 inverses[4];
    vec2 values[4];
    read_pairs(inverse_diagonal, pair, inverses);
#if START == 1
    read_pairs(load, pair, values);
    for (int k = 0; k < 4; ++k) {
        row[k] = first_scale * inverses[k] * values[k];
    }
#else
    read_pairs(correction, pair, row);
    read_coarse(pair, values);
    for (int k = 0; k < 4; ++k) {
        row[k] += mix(vec2(0.0), values[k], greaterThan(inverses[k], vec2(0.0)));
    }
#endif
#endif
}

void kernel(ivec2 pair)
{
    look_around(pair);
    ivec2 at = clamped(pair, textureSize(load, 0));
    vec4 d = vec4(here[1], here[2]);
    vec4 pulls = vec4(force[0], force[1]);
#if SPRINGS
    pulls += texelFetch(springs, at, 0) * d;
#endif
    taken = scale * texelFetch(inverse_diagonal, at, 0) * (texelFetch(load, at, 0) - pulls);
#if START == 0
    taken += momentum * texelFetch(last, at, 0);
#elif START == 1
    taken += momentum * d;
#endif
    corrected = d + taken;
}
