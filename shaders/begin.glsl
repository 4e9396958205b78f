// Start of a level's smoother, for kernels of smooth.glsl that support only START 0.
//
//     START 1    begun = taken = first_scale D^-1 load, the first step from zero
//     START 2    begun = displacement + P coarse where components are free,    taken = 0
//
// with the bilinear interpolation P (interpolation.glsl).
//
// Inputs:  displacement      correction of the level, pixels; pairs
//          load              load of the level, pixels times stiffness; pairs
//          inverse_diagonal  D^-1; 0 where a component is fixed; pairs
//          coarse            correction of the coarser level, pixels; pairs
//          first_scale       no unit
// Outputs: begun             correction after the start, pixels; pairs
//          taken             last step, pixels; pairs
// Border rule: as in interpolation.glsl; the other inputs are read only at the pair itself.

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
