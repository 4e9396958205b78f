// Where a level's smoother begins, for models whose steps cannot find that on the way (smooth.glsl).
//
//     START 1    begun = taken = first_scale D^-1 load: the first step from zero
//     START 2    begun = displacement + the coarser level's correction where sites move,    taken = 0
//
// Inputs:  displacement      the correction so far, pixels; pairs
//          load              what the level is relaxed for; pairs
//          inverse_diagonal  D^-1; 0 where a component does not move; pairs
//          coarse            the coarser level's correction, pixels (interpolation.glsl); pairs
//          first_scale       no unit
// Outputs: begun, taken      pixels; pairs
// Border rule: as that of the interpolation; otherwise a pair reads its own texel only.

uniform float first_scale;

void kernel(ivec2 pair)
{
    ivec2 at = clamped(pair, textureSize(inverse_diagonal, 0));
    vec4 inverses = texelFetch(inverse_diagonal, at, 0);
#if START == 1
    taken = first_scale * inverses * texelFetch(load, at, 0);
    begun = taken;
#else
    vec2 row[4];
    read_coarse(at, row);
    taken = vec4(0.0);
    begun = texelFetch(displacement, at, 0);
    begun += mix(vec4(0.0), vec4(row[1], row[2]), greaterThan(inverses, vec4(0.0)));
#endif
}
