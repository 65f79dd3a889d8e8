# %% [markdown]
# # gradient_of_the_area

# %%
print(1)
