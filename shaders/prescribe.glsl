// Displacement at the start of a solve: observations, and a weighted sum of earlier solutions.
//
//     begun = sum of weight_k solution_k where a component is free, observed elsewhere
//
// Inputs:  observed          observed displacement, pixels; 0 where a component is not observed; pairs
//          inverse_diagonal  D^-1; 0 where a component is fixed; pairs
//          solution_0, solution_1, solution_2, solution_3
//                            earlier solutions, pixels; any texture for weight 0; pairs
//          weights           of the solutions, no unit
// Outputs: begun             pixels; pairs
// Border rule: none needed, because a pair reads only its own texel.

uniform vec4 weights;

void kernel(ivec2 pair)
{
    ivec2 at = clamped(pair, textureSize(observed, 0));
    vec4 sum = weights.x * texelFetch(solution_0, at, 0);
    sum += weights.y * texelFetch(solution_1, at, 0);
    sum += weights.z * texelFetch(solution_2, at, 0);
    sum += weights.w * texelFetch(solution_3, at, 0);
    bvec4 moves = greaterThan(texelFetch(inverse_diagonal, at, 0), vec4(0.0));
    begun = mix(texelFetch(observed, at, 0), sum, moves);
}
