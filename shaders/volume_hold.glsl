// Reciprocal of the finest level's diagonal.
//
//     inverse = 1 / diagonal; 0 where a component is prescribed or has no elements
//
// Inputs:  inverse  diagonal, stiffness
//          pins     1 where a component is prescribed, 0 elsewhere
// Outputs: inverse  reciprocal of the diagonal, 1 / stiffness
//          shares   largest reciprocal in each group: positive if a site in the group is free
// Border rule: none needed, because a site reads only its own values.

void kernel(int at)
{
    for (int k = 0; k < 3; ++k) {
        float diagonal = inverse[k].at[at];
        bool moves = diagonal > 0.0 && pins[k].at[at] == 0.0;
        float value = moves ? 1.0 / diagonal : 0.0;
        inverse[k].at[at] = value;
        most = max(most, value);
    }
}
